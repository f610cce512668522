# SPDX-License-Identifier: Apache-2.0

"""Run `cloudrc link relay`: the emulated link for TCP connections, or for a topic of ROS 2."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from cloudrc.base.errors import BadInputError
from cloudrc.doors.cli.output import output_argument, print_result, tell
from cloudrc.doors.cli.parser import Options, Parser, add_verbs, read_seed, settings_from
from cloudrc.doors.cli.processes import read_address

VERBS = {
    "tcp": "carry TCP connections to a server over the emulated link",
    "ros": "carry a topic of ROS 2 to another topic over the emulated link",
}
"""Verb -> its line in the help."""
EPILOG = None
TCP_EPILOG = """\
example:
  cloudrc link relay tcp --listen 127.0.0.1:8001 --to gpu:8000 --link lte
  cloudrc link set downlink.delay_ms=120      (meanwhile, in another terminal)

A client connects to --listen instead of the server. The uplink leads to the
server. The relay hands bytes on with the link's delay and rate: one round trip
to open, one more for a lost segment, one bottleneck for all connections. A
change by 'cloudrc link set' acts on open connections, too. Ctrl-C ends the
relay, and prints the request-response times: from the last byte of a request
to the first byte of its answer.

It needs no privileges, and is not a congestion control. 'cloudrc link exec'
passes every IP packet through the link instead, with the TCP of the kernel:
use it where it works."""


ROS_EPILOG = """\
examples:
  cloudrc link relay ros --from /odom --to /remote/odom --link lte
  cloudrc link relay ros --from /remote/cmd_vel --to /cmd_vel --link lte \\
      --direction downlink
  cloudrc link set uplink.delay_ms=120      (meanwhile, in another terminal)

Each message is a packet of the link. A message above 1200 bytes is several: of
a BEST_EFFORT topic it is lost with any of them, of a RELIABLE one it is
repaired, and late. The relay waits for a node that publishes --from, and takes
its type. Ctrl-C ends the relay, and prints what the profile asks for and what
was measured.

A subscription that wants RELIABLE hears the relay only with --reliable: then
ROS repeats what it loses itself, but not the small messages that the link
loses.

Needs a sourced ROS 2, exit code 3 without it."""


def arguments(parser: Parser) -> None:
    """Declare the command's arguments."""
    verbs = add_verbs(parser, VERBS)
    tcp, ros = verbs["tcp"], verbs["ros"]
    tcp.epilog, ros.epilog = TCP_EPILOG, ROS_EPILOG
    about = "where clients connect"
    tcp.add_argument("--listen", type=read_address, required=True, metavar="HOST:PORT", help=about)
    tcp.add_argument(
        "--to", type=read_address, required=True, metavar="HOST:PORT", help="the server"
    )
    link_arguments(tcp)
    output_argument(tcp)
    ros.add_argument("--from", dest="source", required=True, metavar="TOPIC", help="topic to hear")
    ros.add_argument("--to", required=True, metavar="TOPIC", help="topic to publish")
    about = "direction of the profile that the messages take (default: uplink)"
    ros.add_argument("--direction", choices=("uplink", "downlink"), default="uplink", help=about)
    ros.add_argument(
        "--reliable", action="store_true", help="publish RELIABLE (default: BEST_EFFORT)"
    )
    link_arguments(ros)
    output_argument(ros)
    about = "name of the link; links with one seed and other names draw other numbers"
    ros.add_argument("--stream", default="", metavar="NAME", help=about)
    about = "new folder for link.json and the recording of the messages"
    ros.add_argument("--out", type=Path, metavar="FOLDER", help=about)


def link_arguments(parser: Parser) -> None:
    """Declare the arguments that choose an emulated link."""
    parser.add_argument(
        "--link", default="ideal", metavar="PROFILE", help="shipped profile, or a file"
    )
    about = "change of the profile, such as uplink.loss=0.05; repeatable"
    parser.add_argument(
        "--set", dest="settings", action="append", default=[], metavar="KEY=VALUE", help=about
    )
    parser.add_argument("--seed", type=read_seed, default=1, metavar="S", help="seed (default: 1)")


def execute(options: Options) -> None:
    """Relay until a signal; print what was measured."""
    if options.verb == "tcp":
        from cloudrc.flight.links.streams import RelaySettings, relay_tcp
        from cloudrc.flight.pod.ports import warn_if_exposed

        if options.to == options.listen:
            text = "is the address of --listen, too; name the server's host and port"
            raise BadInputError(f"--to: {':'.join(map(str, options.to))} {text}")
        warn_if_exposed(options.listen)
        report = relay_tcp(settings_from(options, RelaySettings), tell)
        text = _as_text(report)
    else:
        from cloudrc.doors.bridges.ros2.topics import TopicSettings, relay_topic
        from cloudrc.flight.links.verify import OF_PROGRAMS, as_text

        report = relay_topic(settings_from(options, TopicSettings), tell)
        text = as_text(report, more=OF_PROGRAMS)
    print_result(options.output, report, text)


def _as_text(report: dict[str, Any]) -> str:
    found = report["turns"]  # request-response times
    times = ", ".join(f"{name} {found[name] * 1e3:.1f} ms" for name in found if name != "count")
    return (
        f"{report['connections']} connections, {report['refused']} refused;"
        f" {report['uplink_bytes']} bytes up, {report['downlink_bytes']} down\n"
        f"{found['count']} request-response times{times and ': '}{times}"
    )
