"""Run `cloudrc link exec`: two programs with the emulated link between them."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from cloudrc.cli.output import print_line
from cloudrc.cli.parser import number, read_seed, settings_from, whole_number
from cloudrc.runs.interrupts import interrupt_on_signals

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
says what works here. Without them, use 'cloudrc relay tcp'.

exit codes: that of the client, or of the server if it fails first; 2 bad input,
3 missing prerequisite, 4 the server does not listen in time, 6 the server ended
with 0 before it listened, or the relay failed, 130 interrupted"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the action's arguments."""
    add = parser.add_argument
    add("--link", default="ideal", metavar="PROFILE", help="shipped profile, or a file")
    add("--seed", type=read_seed, default=1, metavar="S", help="seed (default: 1)")
    setting = "change of the profile, such as uplink.loss=0.05; repeatable"
    add("--set", action="append", default=[], metavar="KEY=VALUE", dest="settings", help=setting)
    ends = {"--server": "the program that serves", "--client": "the program that asks"}
    for flag, text in ends.items():
        add(flag, type=_read_command, required=True, metavar="COMMAND", help=text)
    port = whole_number(1, 65535)
    expose = "forward this TCP port of 127.0.0.1 to the server, beside the link; repeatable"
    add("--expose", type=port, action="append", default=[], metavar="PORT", help=expose)
    wait = "longest time for the server to listen (default: 60); 0: start the client at once"
    add("--wait", type=number(0, 3600, "seconds"), default=60.0, metavar="S", help=wait)
    metrics = "serve Prometheus metrics at this port of 127.0.0.1"
    add("--metrics-port", type=port, metavar="PORT", help=metrics)
    output = "new folder for link.json and the recordings of both directions"
    add("-o", "--output", type=Path, metavar="FOLDER", help=output)


def _read_command(text: str) -> str:
    if not text.strip():
        raise argparse.ArgumentTypeError("empty; give a command for the shell")
    return text


def execute(options: argparse.Namespace) -> int:
    """Run both programs, print the verdict on the link, and return the client's exit code."""
    interrupt_on_signals()
    from cloudrc.runs.links.programs import ExecSettings, run_programs
    from cloudrc.runs.links.programs_report import make_exec_report, write_report
    from cloudrc.runs.links.verify import as_text

    def tell(text: str) -> None:
        print_line(f"cloudrc: {text}", sys.stderr)

    settings = settings_from(options, ExecSettings)
    outcome, link = run_programs(settings, tell)
    if link.engine is not None:
        report = make_exec_report(settings, outcome, link)
        print_line("", sys.stderr)
        for line in as_text(report).splitlines():
            print_line(line, sys.stderr)
        if settings.output:
            write_report(settings.output, report, link)
            tell(f"{settings.output}: link.json, uplink.csv, downlink.csv")
    return outcome.code
