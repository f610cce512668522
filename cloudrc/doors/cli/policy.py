# SPDX-License-Identifier: Apache-2.0

"""`cloudrc policy`: serve a policy for robots and evaluations."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from cloudrc.doors.cli.output import print_line, tell
from cloudrc.doors.cli.parser import Options, Parser, add_verbs, whole_number
from cloudrc.doors.cli.processes import number_argument
from cloudrc.flight.pod.openpi import KEY_VARIABLE
from cloudrc.flight.pod.process import StopSignal

VERBS = {
    "serve": "serve a Python policy over openpi's wire, until Ctrl-C",
    "drive": "ask a remote controller for cloud (started by 'run --mode local')",
}
EPILOG = f"""\
examples:
  cloudrc policy serve ./expert.py --port 8000
  {KEY_VARIABLE}=... cloudrc policy serve ./expert.py --host 0.0.0.0

expert.py has a function infer(observation), which returns
{{"actions": array of shape (H, A)}}, and may have reset(), which is called when a
client connects. Or it has build(), which returns an object with these methods.
GET /healthz answers OK. If {KEY_VARIABLE} is set, clients must send this
API key."""


def arguments(parser: Parser) -> None:
    """Declare the command's arguments."""
    serve, drive = add_verbs(parser, VERBS).values()
    serve.add_argument("policy", metavar="POLICY", help="a Python file with infer(observation)")
    about = "address to listen at (default: 127.0.0.1)"
    serve.add_argument("--host", default="127.0.0.1", metavar="HOST", help=about)
    about = "port to listen at; 0: any free port (default: 8000)"
    serve.add_argument(
        "--port", type=whole_number(0, 65_535), default=8000, metavar="N", help=about
    )

    drive.add_argument(
        "--config", type=Path, required=True, metavar="FILE", help="experiment file (YAML)"
    )
    about = "folder of the sockets of 'cloudrc process cloud --teleop DIR'"
    drive.add_argument("--socket", type=Path, required=True, metavar="DIR", help=about)
    number_argument(drive)
    about = "write status for a supervisor to stdout (default: events only)"
    drive.add_argument("--feed", action="store_true", help=about)


def execute(options: Options) -> None:
    """Serve a policy, or ask a remote controller, until the user interrupts."""
    if options.verb == "serve":
        _serve(options)
        return
    stop = StopSignal()
    from cloudrc.flight.pod.ends import run_remote

    run_remote(options.config, options.socket, stop, watched=options.feed, robot=options.robot)


def _serve(options: Options) -> None:
    import asyncio

    from cloudrc.base.outside.code import apart
    from cloudrc.flight.pod.ports import warn_if_exposed
    from cloudrc.flight.pod.realtime import show_address
    from cloudrc.studies.policy.serve import PolicyServer

    host, stdout = options.host, sys.stdout
    warn_if_exposed((host, options.port))

    def ready(port: int) -> None:
        url = f"ws://{show_address((host, port))}"
        print_line(f"policy {options.policy}: {url}", stdout)  # a policy's own output is elsewhere

    server = PolicyServer(options.policy, tell, os.environ.get(KEY_VARIABLE, ""))
    with apart():
        asyncio.run(server.run(host, options.port, ready))
