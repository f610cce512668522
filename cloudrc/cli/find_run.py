"""Find the run on this machine that the flags of a command mean."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from cloudrc.cli.cluster_flags import flown_release
from cloudrc.cli.output import tell
from cloudrc.cli.parser import KUBECTL_PLUGIN, Options, Parser, flags
from cloudrc.errors import BadInputError, MissingPrerequisiteError

if TYPE_CHECKING:
    from cloudrc.cluster.client import Release
    from cloudrc.runs.under_way import RunInFlight


def run_argument(parser: Parser) -> None:
    """Declare the flag `--run`, which names a run on this machine."""
    flags(parser)("--run", "DIR", "folder of a run that is flying on this machine")


def find_local_run(
    options: Options, *, steers: bool = True, links: bool = False
) -> RunInFlight | None:
    """Find the run in flight that a command means; None if its flags name a cluster.

    The parameters and errors are those of `runs.under_way.find_run`.
    """
    in_cluster = options.context or options.namespace or options.release
    if options.run is None and (in_cluster or Path(sys.argv[0]).name == KUBECTL_PLUGIN):
        return None
    if in_cluster:
        raise BadInputError("--run names a run here, the other flags a cluster; give one")
    return find_run_here(options.run, steers=steers, links=links)


def find_run_here(run: Path | None, *, steers: bool, links: bool = False) -> RunInFlight | None:
    """Find a run as `runs.under_way.find_run` does; tell which one was chosen."""
    from cloudrc.runs.under_way import find_run

    found = find_run(run, steers=steers, links=links)
    if found is not None and found.note:
        tell(found.note)
    return found


def need_run_here(run: Path | None, *, steers: bool = True) -> RunInFlight:
    """Find a run as `find_run_here` does; raise a BadInputError if none flies."""
    from cloudrc.runs.under_way import not_found

    if (found := find_run_here(run, steers=steers)) is None:
        raise BadInputError(not_found("no run flies here; start one: cloudrc up"))
    return found


def need_release(options: Options) -> Release:
    """Return the release in flight, for a command that has found no run on this machine."""
    from cloudrc.runs.under_way import not_found

    try:
        return flown_release(options)
    except MissingPrerequisiteError as error:
        if options.context or options.namespace:
            raise
        text = not_found("no run flies here; start one: cloudrc up")
        raise MissingPrerequisiteError(f"{text}; and {error}") from None
