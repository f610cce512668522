"""Run `cloudrc relay tcp`: the emulated link for TCP connections, without privileges."""

from __future__ import annotations

import argparse
import sys
from typing import Any

from cloudrc.cli.output import output_argument, print_line, print_result
from cloudrc.cli.parser import add_verbs, settings_from, whole_number
from cloudrc.cli.processes import read_address
from cloudrc.runs.interrupts import interrupt_on_signals

VERBS = {"tcp": "carry TCP connections to a server over the emulated link"}
"""Verb -> its line in the help."""
EPILOG = """\
example:
  cloudrc relay tcp --listen 127.0.0.1:8001 --to gpu:8000 --link lte
  cloudrc link set downlink.delay_ms=120      (meanwhile, in another terminal)

A client connects to --listen instead of the server. The uplink leads to the
server. The relay hands bytes on as a TCP over the link would: one round trip
to open, slow start, repair of losses, one bottleneck for all connections. A
change by 'cloudrc link set' acts on open connections, too. Ctrl-C ends the
relay, and prints the turns: the times from the last byte of a request to the
first byte of its answer.

It needs no privileges. 'cloudrc link exec' passes every IP packet through the
link instead, also UDP: use it where it works."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    tcp = add_verbs(parser, VERBS)["tcp"]
    tcp.epilog = EPILOG
    add = tcp.add_argument
    listen = "where clients connect"
    add("--listen", type=read_address, required=True, metavar="HOST:PORT", help=listen)
    add("--to", type=read_address, required=True, metavar="HOST:PORT", help="the server")
    add("--link", default="ideal", metavar="PROFILE", help="shipped profile, or a file")
    setting = "change of the profile, such as uplink.loss=0.05; repeatable"
    add("--set", action="append", default=[], metavar="KEY=VALUE", dest="settings", help=setting)
    add("--seed", type=whole_number(0, 2**53 - 1), default=1, metavar="S", help="seed (default: 1)")
    output_argument(tcp)


def execute(options: argparse.Namespace) -> int:
    """Relay connections until a signal; print counts and turns, and return 0."""
    interrupt_on_signals()
    from cloudrc.processes.ports import warn_if_exposed
    from cloudrc.runs.links.streams import RelaySettings, relay_tcp

    warn_if_exposed(options.listen)
    settings = settings_from(options, RelaySettings)
    report = relay_tcp(settings, lambda text: print_line(f"cloudrc: {text}", sys.stderr))
    print_result(options.output, report, _as_text(report))
    return 0


def _as_text(report: dict[str, Any]) -> str:
    turns = report["turns"]
    times = ", ".join(f"{name} {turns[name] * 1e3:.1f} ms" for name in turns if name != "count")
    return (
        f"{report['connections']} connections, {report['refused']} refused;"
        f" {report['uplink_bytes']} bytes up, {report['downlink_bytes']} down\n"
        f"{turns['count']} turns{times and ': '}{times}"
    )
