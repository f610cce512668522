"""`cloudrc replay RUN`: write the 3-D replay of a recorded flight as one page, and open it."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from cloudrc.cli.output import open_page, print_line
from cloudrc.errors import BadInputError
from cloudrc.runs.requirements import require

if TYPE_CHECKING:
    pass

EPILOG = """\
examples:
  cloudrc replay runs/latest
  cloudrc replay runs/latest/mission.mcap --out flight.html --no-open"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of a run, or an MCAP file")
    about = "file for the page (default: replay.html beside the recording)"
    parser.add_argument("--out", type=Path, metavar="FILE", help=about)
    parser.add_argument("--no-open", action="store_true", help="write the page, open no browser")


def execute(options: argparse.Namespace) -> int:
    """Write the page, open it in the browser, and print its path."""
    require("a replay", ("world", "record", "console"))
    from cloudrc.files import write_atomically
    from cloudrc.report.attached import read_flight
    from cloudrc.report.flown import flight_of
    from cloudrc.report.replay import write_page

    run: Path = options.run
    out = options.out or (run if run.is_dir() else run.parent) / "replay.html"
    if options.out and os.path.lexists(out):
        raise BadInputError(f"{out}: already there; name another file with --out")
    recording, experiment = read_flight(run)
    try:
        page = write_page(flight_of(recording, experiment), experiment)
        write_atomically(out, page.encode())
    except BadInputError as error:
        raise BadInputError(f"{run}: no replay: {error}") from error
    if not options.no_open and not open_page(out.absolute().as_uri()):
        print_line("cloudrc: found no browser here; open the page yourself", sys.stderr)
    print_line(str(out))
    return 0
