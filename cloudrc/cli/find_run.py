"""Find the run on this machine that a command refers to."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Collection
from pathlib import Path

from cloudrc.cli.output import print_line
from cloudrc.cli.parser import KUBECTL_PLUGIN
from cloudrc.errors import BadInputError, MissingPrerequisiteError
from cloudrc.runs.folder import RUNS


def run_argument(parser: argparse.ArgumentParser) -> None:
    """Declare the flag `--run`, which names a run on this machine."""
    about = "folder of a run that is flying on this machine"
    parser.add_argument("--run", type=Path, metavar="DIR", help=about)


def short(path: Path) -> str:
    """Format a path relative to the working folder, if it is inside."""
    here = Path.cwd()
    is_inside = path.is_relative_to(here) and here != here.parent  # everything is inside "/"
    return str(path.relative_to(here) if is_inside else path)


def find_local_run(
    options: argparse.Namespace, *, steers: bool = True, flag: str = "--run "
) -> tuple[Path, str] | None:
    """Find the run in flight that a command means: that of `--run`, else the only one.

    If the user's newest run here, ./runs/latest, has ended, a command that changes a flight rejects
    the only run in flight, which may belong to somebody else.

    Args:
        options: Parsed arguments of the command.
        steers: Whether the command changes the flight.
        flag: Flag that names a run, for the texts of errors; "" for a positional argument.

    Returns:
        Folder of the run and URL of its API; None if no run is in flight, or if the flags name a
        cluster.

    Raises:
        BadInputError: If `--run` names no run in flight; if several runs are in flight; or if
            the command changes a flight and ./runs/latest has ended.
    """
    from cloudrc.drivers.local import under_way

    in_cluster = options.context or options.namespace or options.release
    if options.run is None and (in_cluster or Path(sys.argv[0]).name == KUBECTL_PLUGIN):
        return None
    if in_cluster:
        raise BadInputError("--run names a run here, the other flags a cluster; give one")
    # The URL comes from this user's flight files, never from the run's folder: a run's folder may
    # come from somebody else and name a foreign server.
    flights = under_way()
    if options.run is not None:
        url = flights.get(Path(os.path.realpath(options.run)))
        if url is None:
            raise BadInputError(f"{flag}{options.run}: no run flies there; name another folder")
        return options.run, url
    ask_if_unclear(flights, steers=steers, flag=flag)
    return next(((Path(short(run)), url) for run, url in flights.items()), None)


def ask_if_unclear(candidates: Collection[Path], *, steers: bool, flag: str = "--run ") -> None:
    """Raise a BadInputError if it is unclear which flight the user means.

    It is unclear if there are several `candidates`, the folders of the local runs that the command
    can use. If the command changes a flight (`steers`), it is also unclear if ./runs/latest has
    ended or cannot be used. `flag` names a run in error messages.
    """
    from cloudrc.drivers.local import LINK_LOG, under_way

    latest = Path(os.path.realpath(RUNS / "latest"))
    names = " or ".join(f"{flag}{short(run)}" for run in sorted(candidates))
    if len(candidates) > 1:
        raise BadInputError(f"{len(candidates)} runs are flying here; choose one: {names}")
    is_mine = latest in candidates
    if steers and not is_mine and (latest / LINK_LOG).exists():  # this user steered that flight
        names = names or "--release NAME (in a cluster)"
        why = "does not take this command" if latest in under_way() else "has ended"
        raise BadInputError(
            f"{short(latest)} {why}; name another flight: {names}; or start one: cloudrc up"
        )
    if candidates and not is_mine:
        print_line(f"cloudrc: using the run in {names.removeprefix(flag)}", sys.stderr)


def no_run_error(
    options: argparse.Namespace, error: MissingPrerequisiteError, flags: str
) -> MissingPrerequisiteError:
    """Return an error which says that neither this machine nor a cluster has a run in flight.

    `error` is the reason why no cluster was found. It is returned unchanged if the user gave
    --context or --namespace. The text suggests `flags`, the flags that name a local run.
    """
    if options.context or options.namespace:
        return error
    return MissingPrerequisiteError(
        f"no run flies here (start one: cloudrc run; or name one: {flags}), and {error}"
    )
