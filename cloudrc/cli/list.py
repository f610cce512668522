"""`cloudrc list`: list the names that an experiment may use, or the releases of a cluster."""

from __future__ import annotations

import argparse

from cloudrc.cli.cluster_flags import cluster_arguments
from cloudrc.cli.output import output_argument, paint, print_result
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
        from cloudrc.cli.releases import list_releases

        return list_releases(options)
    if options.context or options.namespace:
        raise BadInputError(f"--context and --namespace are for 'cloudrc list {RELEASES}'")
    found = {kind: describe_all(kind) for kind in ([options.what] if options.what else KINDS)}
    entries = {
        kind: [{"name": name, "description": text} for name, text in lines.items()]
        for kind, lines in found.items()
    }
    print_result(options.output, entries, as_text(found, paint))
    return 0
