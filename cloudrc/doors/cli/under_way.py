# SPDX-License-Identifier: Apache-2.0

"""Find the run on this machine that a command or a call refers to."""

from __future__ import annotations

import os
from collections.abc import Collection
from pathlib import Path
from typing import NamedTuple

from cloudrc.base.errors import BadInputError, MissingPrerequisiteError
from cloudrc.doors.cli.output import tell
from cloudrc.flight.folder import RUNS
from cloudrc.flight.local.places import LINK_LOG
from cloudrc.results.under_way import SESSION, flight_files, under_way


class RunInFlight(NamedTuple):
    """A run that flies on this machine."""

    folder: Path
    url: str  # of its API


def short(path: Path) -> str:
    """Format a path relative to the working folder, if it is inside."""
    here = Path.cwd()
    is_inside = path.is_relative_to(here) and here != here.parent  # everything is inside "/"
    return str(path.relative_to(here) if is_inside else path)


def find_run(
    run: Path | None, *, steers: bool = True, links: bool = False, elsewhere: bool = True
) -> RunInFlight | None:
    """Find the run in flight that a user means: `run`, else the only one; tell if it is another's.

    If the user's newest run here, ./runs/latest, has ended, a command that changes a flight rejects
    the only run in flight, which may belong to somebody else. A link without a flight is taken.

    Args:
        run: Folder of the run; None if the user names none.
        steers: Whether the command changes the flight.
        links: Whether the command can also use a link of `link exec` or `link relay tcp`.
        elsewhere: Whether to take a run outside of the working folder that the user has not named.

    Returns:
        The run; None if no run is in flight.

    Raises:
        BadInputError: If `run` is not in flight; if several runs are in flight; if the command
            changes a flight and ./runs/latest has ended; or if all runs are `elsewhere`.
    """
    # The URL comes from this user's flight files, never from the run's folder: a run's folder may
    # come from somebody else and name a foreign server.
    flights = under_way(links=links)
    if run is not None:
        url = flights.get(Path(os.path.realpath(run)))
        if url is None:
            raise BadInputError(f"{run}: no run flies there; name another folder")
        return RunInFlight(run, url)
    if not elsewhere and flights:
        inside = {run: flights[run] for run in flights if run.is_relative_to(Path.cwd())}
        if not inside:
            text = "no run flies in this folder; if you mean another one, name it"
            raise BadInputError(f"{text}: {_flags(flights)}")
        flights = inside
    without_flight = bool(flights) and flights.keys().isdisjoint(under_way())
    ask_if_unclear(flights, steers=steers and not without_flight)
    return next((RunInFlight(Path(short(run)), url) for run, url in flights.items()), None)


def find_session(run: Path | None) -> Path:
    """Return the folder of the session that a user means: `run`, else that of the only one here.

    Raises:
        BadInputError: If no session runs in `run`, or if it is unclear which one is meant.
        MissingPrerequisiteError: If no session runs here.
    """
    sessions = [folder for folder, flight in flight_files().items() if flight.kind == SESSION]
    if run is not None:
        if run.resolve() not in sessions:
            raise BadInputError(f"--run {run}: no session runs there")
        return run.resolve()
    if not sessions:
        text = "start one: cloudrc up; a flight of 'cloudrc run' ends by Ctrl-C there"
        raise MissingPrerequisiteError(f"no session runs here; {text}")
    ask_if_unclear(sessions, steers=True)
    return sessions[0]


def ask_if_unclear(candidates: Collection[Path], *, steers: bool) -> None:
    """Raise a BadInputError if it is unclear which flight the user means; tell which it may be.

    It is unclear if there are several `candidates`, the folders of the local runs that the command
    can use. If the command changes a flight (`steers`), it is also unclear if ./runs/latest has
    ended or cannot be used.
    """
    latest = Path(os.path.realpath(RUNS / "latest"))
    names = " or ".join(short(run) for run in sorted(candidates))
    if len(candidates) > 1:
        raise BadInputError(
            f"{len(candidates)} runs are flying here; name one: {_flags(candidates)}"
        )
    is_mine = latest in candidates
    if steers and not is_mine and (latest / LINK_LOG).exists():  # this user steered that flight
        others = _flags(candidates) or "--release NAME (in a cluster)"
        text = f"has ended, or does not take this command; name another flight: {others}"
        raise BadInputError(f"{short(latest)}: {text}; or start one: cloudrc up")
    if candidates and not is_mine:
        tell(f"using the run in {names}")


def _flags(runs: Collection[Path]) -> str:
    """Return the flags that name runs, such as "--run a or --run b"."""
    return " or ".join(f"--run {short(run)}" for run in sorted(runs))
