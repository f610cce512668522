# SPDX-License-Identifier: Apache-2.0

"""Run `cloudrc link set`: change the link during a flight, on this machine or in a cluster."""

from __future__ import annotations

import secrets
from dataclasses import asdict, replace
from time import monotonic
from typing import TYPE_CHECKING

from cloudrc.base.errors import MissingPrerequisiteError
from cloudrc.base.text import escape
from cloudrc.cluster.client import ClusterError, Release
from cloudrc.doors.cli.output import output_argument, print_result, tell
from cloudrc.doors.cli.parser import Options, Parser
from cloudrc.doors.cli.where import find_local_run, need_release, release_arguments, run_argument

if TYPE_CHECKING:
    from cloudrc.cluster.link import LinkParts

EPILOG = """\
where:
  a run on this machine ('cloudrc up', 'cloudrc run', 'cloudrc link exec',
  'cloudrc link relay tcp'): found automatically, or named by --run
  a release in a cluster: if --context, -n or --release is given, or if there is
  no run on this machine; always with 'kubectl cloudrc link set'
  If several runs fly, or ./runs/latest has ended and another flight has begun,
  name the run by a flag.

examples:
  cloudrc link set downlink.delay_ms=120 uplink.loss=0.02
  cloudrc link set --profile handover
  cloudrc link set --profile wifi uplink.rate_kbit=400 -n demo

KEY is a key of a direction in a profile file. With --profile, schedules start
anew; single values leave them running. The change is recorded. It lasts until
the next change, the end of the run, or 'helm upgrade'."""


def arguments(parser: Parser) -> None:
    """Declare the command's arguments."""
    about = "uplink.KEY=VALUE or downlink.KEY=VALUE"
    parser.add_argument("settings", nargs="*", metavar="KEY=VALUE", help=about)
    parser.add_argument("--profile", metavar="NAME", help="shipped profile, or a file")
    run_argument(parser)
    output_argument(parser)
    release_arguments(parser)


def execute(options: Options) -> None:
    """Change the link as the flags say, and print the new state of the link."""
    began, number = monotonic(), secrets.token_hex(4)
    from cloudrc.flight.links.change import set_here, states_table
    from cloudrc.flight.local.places import LINK_FOLDER

    if (found := find_local_run(options, links=True)) is not None:
        where, asked = str(found.folder), (options.profile, options.settings)
        edit, states = set_here(found.folder / LINK_FOLDER, found.url, *asked, number)
        took = monotonic() - began
    else:
        from cloudrc.cluster.link import keep, send

        place = Release(options.context, options.namespace, options.release or "")
        link = _link_of(options, place)
        place = replace(place, name=link.release)
        sent = send(place, link, options.profile, options.settings, number)
        took = monotonic() - began
        keep(place, link, sent)
        where = f"release '{place.name}'{f' {place.where}' if place.namespace else ''}"
        edit, states = sent.edit, sent.states
    for text in edit.notes:
        tell(f"note: {text}")
    links = {state.direction: asdict(state) for state in states}
    document = {"change": number, "seconds": round(took, 3), "links": links}
    said = escape(f"{where}: in force after {took:.1f} s")
    print_result(options.output, document, f"{states_table(states)}\n{said}")


def _link_of(options: Options, where: Release) -> LinkParts:
    from cloudrc.cluster.link import read_link
    from cloudrc.cluster.pods import find_pod

    try:
        return read_link(where)
    except (ClusterError, MissingPrerequisiteError):  # such as kubectl
        release = need_release(options)
        for part in ("world", "cloud"):
            find_pod(release, part)  # raises the most precise error
        raise
