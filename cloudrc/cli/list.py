"""`cloudrc list`: list the names that an experiment may use, or the releases of a cluster."""

from __future__ import annotations

import argparse
import sys

from cloudrc.cli.cluster_flags import cluster_arguments, release_from_flags
from cloudrc.cli.output import output_argument, paint, print_line, print_result
from cloudrc.errors import BadInputError
from cloudrc.runs.catalogue import KINDS, as_text, describe_all

RELEASES = "releases"
EPILOG = """\
examples:
  cloudrc list
  cloudrc list profiles
  cloudrc list releases -n lab
  cloudrc run --set link.profile=satellite --mode virtual"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    about = f"one of {', '.join(KINDS)}; or {RELEASES}, those of a cluster"
    choices = (*KINDS, RELEASES)
    parser.add_argument("what", nargs="?", choices=choices, metavar="WHAT", help=about)
    output_argument(parser)
    cluster_arguments(parser, "of the releases (default: all)")


def execute(options: argparse.Namespace) -> int:
    """Print name and description of each plug-in or shipped file of one kind, or of all kinds."""
    if options.what == RELEASES:
        return _list_releases(options)
    if options.context or options.namespace:
        raise BadInputError(f"--context and --namespace are for 'cloudrc list {RELEASES}'")
    found = {kind: describe_all(kind) for kind in ([options.what] if options.what else KINDS)}
    entries = {
        kind: [{"name": name, "description": text} for name, text in lines.items()]
        for kind, lines in found.items()
    }
    print_result(options.output, entries, as_text(found, paint))
    return 0


def _list_releases(options: argparse.Namespace) -> int:
    """Print the releases of all namespaces, or of the namespace that the flags name."""
    release = release_from_flags(options)
    from cloudrc.cluster import fleet

    found = fleet.list_releases(
        release,
        everywhere=not options.namespace,
        tell=lambda text: print_line(f"cloudrc: note: {text}", sys.stderr),
    )
    print_result(options.output, {"releases": found}, fleet.as_text(found))
    return 0
