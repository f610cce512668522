# SPDX-License-Identifier: Apache-2.0

"""`cloudrc list`: list the names that an experiment may use, or the releases of a cluster."""

from __future__ import annotations

from cloudrc.doors.catalogue import KINDS, as_text, describe_all
from cloudrc.doors.cli.output import output_argument, paint, print_result, tell
from cloudrc.doors.cli.parser import Options, Parser
from cloudrc.doors.cli.where import cluster_arguments, release_from_flags

RELEASES = "releases"
EPILOG = """\
examples:
  cloudrc list
  cloudrc list profiles
  cloudrc list releases -n lab
  cloudrc run --set link.profile=satellite --mode virtual"""


def arguments(parser: Parser) -> None:
    """Declare the command's arguments."""
    about = f"one of {', '.join(KINDS)}; or {RELEASES}, those of a cluster"
    choices = (*KINDS, RELEASES)
    parser.add_argument("what", nargs="?", choices=choices, metavar="WHAT", help=about)
    output_argument(parser)
    cluster_arguments(parser, "of the releases (default: all)")


def execute(options: Options) -> None:
    """Print name and description of each plug-in or shipped file of one kind, or of all kinds."""
    if options.what == RELEASES:
        _list_releases(options)
        return
    found = {kind: describe_all(kind) for kind in ([options.what] if options.what else KINDS)}
    entries = {
        kind: [{"name": name, "description": text} for name, text in lines.items()]
        for kind, lines in found.items()
    }
    print_result(options.output, entries, as_text(found, paint))


def _list_releases(options: Options) -> None:
    """Print the releases of all namespaces, or of the namespace that the flags name."""
    release = release_from_flags(options)
    from cloudrc.cluster import fleet

    found = fleet.list_releases(release, everywhere=not options.namespace, tell=tell)
    print_result(options.output, {"releases": found}, fleet.as_text(found))
