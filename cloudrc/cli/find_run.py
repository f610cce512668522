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


def find_local_run(
    options: argparse.Namespace, look: Callable[[Path, str], _Found | None], nobody: str
) -> _Found | None:
    """Find a run in flight: the folder of `--run`, else ./runs/latest, else the only run in flight.

    Call `look` with the run's folder and the URL of its API ("" if the run has no API), and return
    the result of `look`. Return None if no run is in flight or if the flags name a cluster. If
    `--run` names a run that is not in flight, raise an error with the text `nobody`.
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

    def find(run: Path) -> _Found | None:
        real = Path(os.path.realpath(run))
        return look(run, flights[real]) if real in flights else None

    if options.run is not None:
        if (found := find(options.run)) is None:
            raise BadInputError(f"--run {options.run}: {nobody}")
        return found
    if (found := find(RUNS / "latest")) is not None:
        return found
    others = {run: found for run in flights if (found := find(run)) is not None}
    if len(others) > 1:
        names = " or ".join(f"--run {run}" for run in others)
        raise BadInputError(f"{len(others)} runs are flying here; choose one: {names}")
    for run in others:
        print_line(f"cloudrc: using the run in {run}", sys.stderr)
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
