"""`cloudrc recover FILE`: copy what is readable of a damaged recording into a valid file."""

from __future__ import annotations

import argparse
import os
import sys
from contextlib import closing
from dataclasses import asdict
from pathlib import Path

from cloudrc.cli.output import output_argument, print_result
from cloudrc.errors import BadInputError
from cloudrc.runs.requirements import require
from cloudrc.text import escape

LOSSY = 1
"""Exit code if the copy lacks data of the recording."""
EPILOG = """\
examples:
  cloudrc recover runs/latest/world.mcap
  cloudrc recover torn.mcap --to clean.mcap -o json

exit codes: 0 complete, 1 some data is lost (printed), 2 nothing readable, or
  still in flight"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("file", type=Path, metavar="FILE", help="a recording (.mcap)")
    about = "file for the clean copy (default: FILE with '.recovered' before its ending)"
    parser.add_argument("-t", "--to", type=Path, metavar="NEW", help=about)
    output_argument(parser)


def execute(options: argparse.Namespace) -> int:
    """Copy a damaged recording; print which share of the data was kept, and the known losses."""
    require("a recovery", ("record",))
    from cloudrc.cli.progress import StepView
    from cloudrc.record.recovery import recover
    from cloudrc.report.attached import attached_views
    from cloudrc.runs.session import refuse_under_way

    source: Path = options.file
    refuse_under_way(source.resolve().parent)
    target = options.to or source.parent / f"{source.stem}.recovered{source.suffix}"
    if os.path.lexists(target):
        raise BadInputError(f"{target}: already there; name another file with --to")
    with closing(StepView(sys.stderr, f"copies what is readable of {source}")):
        recovery = recover(source, target, attached_views)
    text = "\n".join(map(escape, [*recovery.as_lines(), str(target)]))
    print_result(options.output, {"file": str(target), **asdict(recovery)}, text)
    return 0 if recovery.complete else LOSSY
