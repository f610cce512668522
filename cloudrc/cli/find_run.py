"""Find the run on this machine that the flags of a command mean."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from cloudrc.cli.output import print_line
from cloudrc.cli.parser import KUBECTL_PLUGIN
from cloudrc.errors import BadInputError, MissingPrerequisiteError

if TYPE_CHECKING:
    from cloudrc.runs.under_way import RunInFlight


def run_argument(parser: argparse.ArgumentParser) -> None:
    """Declare the flag `--run`, which names a run on this machine."""
    about = "folder of a run that is flying on this machine"
    parser.add_argument("--run", type=Path, metavar="DIR", help=about)


def find_local_run(
    options: argparse.Namespace, *, steers: bool = True, flag: str = "--run ", links: bool = False
) -> RunInFlight | None:
    """Find the run in flight that a command means; None if its flags name a cluster.

    The parameters and errors are those of `runs.under_way.find_run`.
    """
    from cloudrc.runs.under_way import find_run

    in_cluster = options.context or options.namespace or options.release
    if options.run is None and (in_cluster or Path(sys.argv[0]).name == KUBECTL_PLUGIN):
        return None
    if in_cluster:
        raise BadInputError("--run names a run here, the other flags a cluster; give one")
    found = find_run(options.run, steers=steers, flag=flag, links=links)
    if found is not None and found.note:
        print_line(f"cloudrc: {found.note}", sys.stderr)
    return found


def no_run_error(
    options: argparse.Namespace, error: MissingPrerequisiteError, flags: str
) -> MissingPrerequisiteError:
    """Return an error which says that neither this machine nor a cluster has a run in flight.

    `error` is the reason why no cluster was found. It is returned unchanged if the user gave
    --context or --namespace. The text suggests `flags`, the flags that name a local run.
    """
    if options.context or options.namespace:
        return error
    from cloudrc.runs.under_way import not_found

    text = not_found(f"no run flies here (start one: cloudrc run; or name one: {flags})")
    return MissingPrerequisiteError(f"{text}, and {error}")
