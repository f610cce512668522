# SPDX-License-Identifier: Apache-2.0

"""Run `cloudrc process teleop`: it stores and commands missions, and serves the API."""

from __future__ import annotations

from pathlib import Path

from cloudrc.base.errors import BadInputError
from cloudrc.base.requirements import require
from cloudrc.doors.cli.parser import Options, Parser, settings_from
from cloudrc.doors.cli.processes import process_arguments, read_address
from cloudrc.flight.pod.process import StopSignal
from cloudrc.flight.pod.realtime import Address

EPILOG = """\
teleop talks to 'cloudrc process cloud --teleop DIR' through two sockets in DIR.
It ends on SIGTERM, on Ctrl-C and when its parent process has ended; with
--start also after the mission. A flying robot then holds; a new teleop with the
same --journal resumes the mission.

/openapi.json describes the API. The API asks for a token, except on a socket
file, which only its owner can open. To make a token that only you can read:
(umask 077; openssl rand -hex 32 > DIR/operator). A token in DIR/reader may only
read."""


def arguments(parser: Parser) -> None:
    """Declare the command's arguments."""
    process_arguments(parser)
    where = (
        "serve the API here: [HOST:]PORT (default HOST: 127.0.0.1; PORT 0: any free port) or "
        "unix:PATH, for your user only"
    )
    parser.add_argument(
        "--socket", type=Path, required=True, metavar="DIR", help="folder of the two sockets"
    )
    parser.add_argument("--api", type=api_address, required=True, metavar="WHERE", help=where)
    about = "folder of the token files 'operator' and 'reader'"
    parser.add_argument("--tokens", type=Path, metavar="DIR", help=about)
    parser.add_argument(
        "--api-file", type=Path, metavar="FILE", help="write the API's URL to this file"
    )
    about = "state of the link: its changes go to the mission's log"
    parser.add_argument("--link", type=Path, metavar="FILE", help=about)
    about = "store missions in this file (default: not stored)"
    parser.add_argument("--journal", type=Path, metavar="FILE", help=about)
    about = "fly the experiment's mission, or that of --journal, then exit"
    parser.add_argument("--start", action="store_true", help=about)


def api_address(text: str) -> Address | Path:
    """Parse [HOST:]PORT or unix:PATH for argparse; PORT 0 means any free port."""
    if text.startswith("unix:") and len(text) > len("unix:"):
        return Path(text.removeprefix("unix:"))
    host, colon, port = text.rpartition(":")
    host = host if colon else "127.0.0.1"
    return (host.strip("[]"), 0) if host and port == "0" else read_address(f"{host}:{port}")


def execute(options: Options) -> None:
    """Run teleop until a signal stops the process or, with --start, the mission has ended."""
    if options.tokens is None and not isinstance(options.api, Path):
        raise BadInputError(
            "--api HOST:PORT needs --tokens DIR, with a file 'operator' in it; "
            "without tokens only a socket file is served: --api unix:PATH"
        )
    require("the API of teleop", ("api",))
    stop = StopSignal()
    from cloudrc.flight.pod.teleop import TeleopSettings, run_teleop

    run_teleop(settings_from(options, TeleopSettings), stop)
