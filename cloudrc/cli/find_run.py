"""Find the run on this machine that a command refers to."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from cloudrc.cli.output import print_line
from cloudrc.errors import BadInputError, MissingPrerequisiteError

_Found = TypeVar("_Found")
RUNS = Path("runs")
KUBECTL_PLUGIN = "kubectl-cloudrc"
"""Name of this program when kubectl starts it as a plugin."""


def run_argument(parser: argparse.ArgumentParser) -> None:
    """Declare the flag `--run`, which names a run on this machine."""
    about = "folder of a run that is flying on this machine"
    parser.add_argument("--run", type=Path, metavar="DIR", help=about)


def short(path: Path) -> str:
    """Format a path relative to the working folder, if it is inside."""
    here = Path.cwd()
    return str(path.relative_to(here) if path.is_relative_to(here) else path)


def find_local_run(
    options: argparse.Namespace,
    look: Callable[[Path, str], _Found | None],
    nobody: str,
    *,
    steers: bool = True,
) -> _Found | None:
    """Find the run in flight that a command means: the folder of `--run`, else the only run.

    Call `look` with the run's folder and the URL of its API ("" if the run has no API), and return
    the result of `look`. Return None if no run is in flight or if the flags name a cluster.

    Raises:
        BadInputError: If `--run` names a run that is not in flight, with the text `nobody`; if
            several runs are in flight; or if the command `steers` and ./runs/latest, a run in real
            time, has ended: the command must not reach another flight instead.
    """
    from cloudrc.drivers.local import RELAY_LOG, under_way

    in_cluster = options.context or options.namespace or options.release
    if options.run is None and (in_cluster or Path(sys.argv[0]).name == KUBECTL_PLUGIN):
        return None
    if in_cluster:
        raise BadInputError("--run names a run here, the other flags a cluster; give one")
    # The URL comes from this user's flight files, never from the run's folder: a run's folder may
    # come from somebody else and name a foreign server.
    flights = under_way()

    def find(run: Path) -> _Found | None:
        real = Path(os.path.realpath(run))
        return look(run, flights[real]) if real in flights else None

    if options.run is not None:
        if (found := find(options.run)) is None:
            raise BadInputError(f"--run {options.run}: {nobody}")
        return found
    last, others = RUNS / "latest", {}
    for run, api in flights.items():
        if (found := look(Path(short(run)), api)) is not None:
            others[run] = found
    if len(others) > 1:
        names = " or ".join(f"--run {short(run)}" for run in others)
        raise BadInputError(f"{len(others)} runs are flying here; choose one: {names}")
    real = Path(os.path.realpath(last))
    if steers and real not in others and (last / RELAY_LOG).exists():
        state = "cannot be steered" if real in flights else "has ended"
        which = "".join(f"--run {short(run)}, " for run in others)
        raise BadInputError(
            f"{short(real)} {state}; name another flight: {which}--release NAME (in a cluster), or "
            "start one: cloudrc up"
        )
    for run in others:
        if run != real:
            print_line(f"cloudrc: using the run in {short(run)}", sys.stderr)
    return next(iter(others.values()), None)


def no_run_error(
    options: argparse.Namespace, error: MissingPrerequisiteError, flags: str
) -> MissingPrerequisiteError:
    """Add to `error` (no cluster was found) that no run is in flight on this machine either.

    If the flags name a cluster, return `error` unchanged. `flags` lists the flags that name a
    local run, for the error text.
    """
    if options.context or options.namespace:
        return error
    return MissingPrerequisiteError(
        f"no run flies here (start one: cloudrc run; or name one: {flags}), and {error}"
    )
