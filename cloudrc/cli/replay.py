# SPDX-License-Identifier: Apache-2.0

"""`cloudrc replay RUN`: write the 3-D replay of a recorded flight as one page, and open it."""

from __future__ import annotations

from cloudrc.cli.output import open_page, print_line, tell
from cloudrc.cli.parser import Options, Parser, flags
from cloudrc.outside.paths import check_new

EPILOG = """\
examples:
  cloudrc replay runs/latest
  cloudrc replay runs/latest/mission.mcap --out flight.html --no-open"""


def arguments(parser: Parser) -> None:
    """Declare the command's arguments."""
    add = flags(parser)
    add("run", "RUN", "folder of a run, or an MCAP file")
    add("--out", "FILE", "file for the page (default: replay.html beside the recording)")
    add("--no-open", "", "write the page, open no browser")


def execute(options: Options) -> None:
    """Write the page, open it in the browser, and print its path."""
    if options.out is not None:
        check_new(options.out, "name another file with --out")
    from cloudrc.cli.progress import Progress
    from cloudrc.runs.replay import write_replay

    with Progress(f"reads the recording of {options.run}"):
        out = write_replay(options.run, options.out)
    if not options.no_open and not open_page(out.absolute().as_uri()):
        tell("found no browser here; open the page yourself")
    print_line(str(out))
