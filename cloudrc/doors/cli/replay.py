# SPDX-License-Identifier: Apache-2.0

"""`cloudrc replay RUN`: write the 3-D replay of a recorded flight as one page, and open it."""

from __future__ import annotations

from pathlib import Path

from cloudrc.base.outside.paths import check_new
from cloudrc.doors.cli.output import open_page, print_line, tell
from cloudrc.doors.cli.parser import Options, Parser

EPILOG = """\
examples:
  cloudrc replay runs/latest
  cloudrc replay runs/latest/mission.mcap --out flight.html --no-open"""


def arguments(parser: Parser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of a run, or an MCAP file")
    about = "file for the page (default: replay.html beside the recording)"
    parser.add_argument("--out", type=Path, metavar="FILE", help=about)
    parser.add_argument("--no-open", action="store_true", help="write the page, open no browser")


def execute(options: Options) -> None:
    """Write the page, open it in the browser, and print its path."""
    if options.out is not None:
        check_new(options.out, "name another file with --out")
    from cloudrc.doors.cli.progress import Progress
    from cloudrc.doors.replay import write_replay

    with Progress(f"reads the recording of {options.run}"):
        out = write_replay(options.run, options.out)
    if not options.no_open and not open_page(out.absolute().as_uri()):
        tell("found no browser here; open the page yourself")
    print_line(str(out))
