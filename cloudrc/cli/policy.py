"""`cloudrc policy`: serve a policy for robots and evaluations."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from cloudrc.cli.output import print_line
from cloudrc.cli.parser import add_verbs, whole_number
from cloudrc.drivers.process import StopSignal
from cloudrc.policy.address import KEY_VARIABLE
from cloudrc.runs.interrupts import interrupt_on_signals
from cloudrc.runs.requirements import require

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


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    serve, drive = add_verbs(parser, VERBS).values()
    add = serve.add_argument
    add("policy", metavar="POLICY", help="a Python file with infer(observation)")
    about = "address to listen at (default: 127.0.0.1)"
    add("--host", default="127.0.0.1", metavar="HOST", help=about)
    about = "port to listen at; 0: any free port (default: 8000)"
    add("--port", type=whole_number(0, 65_535), default=8000, metavar="N", help=about)

    about = "experiment file (YAML)"
    drive.add_argument("--config", type=Path, metavar="FILE", required=True, help=about)
    about = "folder of the sockets of 'cloudrc cloud --teleop DIR'"
    drive.add_argument("--socket", type=Path, metavar="DIR", required=True, help=about)
    about = "write status for a supervisor to stdout (default: events only)"
    drive.add_argument("--feed", action="store_true", help=about)


def execute(options: argparse.Namespace) -> int:
    """Serve a policy, or ask a remote controller, until the user interrupts."""
    if options.verb == "drive":
        stop = StopSignal()
        require("a remote controller", ("policy",))
        from cloudrc.processes.ends import run_remote

        run_remote(options.config, options.socket, stop, watched=options.feed)
        return 0
    return _serve(options)


def _serve(options: argparse.Namespace) -> int:
    require("a policy's server", ("policy",))
    import asyncio

    from cloudrc.drivers.realtime import show_address
    from cloudrc.outside.code import apart
    from cloudrc.policy.serve import PolicyServer
    from cloudrc.processes.ports import warn_if_exposed

    interrupt_on_signals()
    host, stdout = options.host, sys.stdout
    warn_if_exposed((host, options.port))

    def ready(port: int) -> None:
        url = f"ws://{show_address((host, port))}"
        print_line(f"policy {options.policy}: {url}", stdout)  # a policy's own output is elsewhere

    def tell(text: str) -> None:
        print_line(f"cloudrc: {text}", sys.stderr)

    server = PolicyServer(options.policy, tell, os.environ.get(KEY_VARIABLE, ""))
    with apart():
        asyncio.run(server.run(host, options.port, ready))
    return 0
