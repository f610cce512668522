# SPDX-License-Identifier: Apache-2.0

"""Run `cloudrc link exec`: two programs with the emulated link between them."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from cloudrc.doors.cli.link_relay import link_arguments
from cloudrc.doors.cli.output import print_lines, tell
from cloudrc.doors.cli.parser import Options, Parser, number, settings_from, whole_number

EPILOG = """\
examples:
  cloudrc link exec --link lte --server "python serve_policy.py" \\
      --client "python robot.py --host {server}"
  cloudrc link exec --link wifi --set uplink.loss=0.02 -o out \\
      --server "python -m http.server 80" --client "curl http://{server}/"
  cloudrc link set downlink.delay_ms=120      (meanwhile, in another terminal)

Each program has a network of its own, and every IP packet between them passes
the link: TCP, UDP, QUIC, gRPC and DDS as they are. The uplink leads from client
to server. The shell runs the commands; {server} and {client} become IPv4
addresses, {server6} and {client6} IPv6 addresses. The client starts once the
server listens. The programs cannot reach other networks.

The model draws by packet number, and the numbers depend on timing: one seed
gives the same kind of run, not the same bytes.

Needs root or unprivileged user namespaces, and /dev/net/tun: 'cloudrc doctor'
says what works here. Without them, use 'cloudrc link relay tcp'.

exit codes: that of the client, or of the server if it fails first; 2 bad input,
3 missing prerequisite, 4 the server does not listen in time, 6 the server ended
with 0 before it listened, or the relay failed, 130 interrupted"""

HIDING = "ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST", "ROS_LOCALHOST_ONLY=1"
"""Settings with which a node of ROS 2 finds those on its own machine only."""


def arguments(parser: Parser) -> None:
    """Declare the action's arguments."""
    link_arguments(parser)
    parser.add_argument(
        "--server", required=True, metavar="COMMAND", help="the program that serves"
    )
    parser.add_argument("--client", required=True, metavar="COMMAND", help="the program that asks")
    port = whole_number(1, 65535)
    about = "forward this TCP port of 127.0.0.1 to the server, beside the link; repeatable"
    parser.add_argument(
        "--expose", action="append", type=port, default=[], metavar="PORT", help=about
    )
    about = "longest time for the server to listen (default: 60); 0: start the client at once"
    parser.add_argument(
        "--wait", type=number(0, 3600, "seconds"), default=60.0, metavar="S", help=about
    )
    about = "serve Prometheus metrics at this port of 127.0.0.1"
    parser.add_argument("--metrics-port", type=port, metavar="PORT", help=about)
    about = "new folder for link.json and the recordings of both directions"
    parser.add_argument("-o", "--output", type=Path, metavar="FOLDER", help=about)


def _warn_of_hidden_nodes(*commands: str) -> None:
    """Warn if a setting lets nodes of ROS 2 find no node at the other end."""
    for setting in HIDING:
        name, _, value = setting.partition("=")
        if os.environ.get(name) == value or any(setting in command for command in commands):
            tell(f"warning: {setting}: nodes of ROS 2 at the two ends do not find each other")


def execute(options: Options) -> int:
    """Run both programs, print the verdict on the link, and return the client's exit code."""
    from cloudrc.flight.links.programs import ExecSettings, run_programs
    from cloudrc.flight.links.programs_report import make_exec_report, write_report
    from cloudrc.flight.links.verify import OF_PROGRAMS, as_text

    _warn_of_hidden_nodes(options.server, options.client)
    settings = settings_from(options, ExecSettings)
    outcome, link = run_programs(settings, tell)
    if link.engine is not None:
        report = make_exec_report(settings, outcome, link)
        print_lines(["", *as_text(report, more=OF_PROGRAMS).splitlines()], sys.stderr)
        if settings.output:
            write_report(settings.output, report, link)
            tell(f"{settings.output}: link.json, uplink.csv, downlink.csv")
    return outcome.code
