"""`cloudrc recover FILE`: copy a damaged recording, up to the first damage, into a valid file."""

from __future__ import annotations

import argparse
import os
from dataclasses import asdict
from pathlib import Path

from cloudrc.cli.extras import require
from cloudrc.cli.output import escape, output_argument, print_result
from cloudrc.errors import BadInputError

LOSSY = 1
"""Exit code if the copy lacks data of the recording."""
EPILOG = """\
examples:
  cloudrc recover runs/latest/world.mcap
  cloudrc recover torn.mcap --to clean.mcap -o json

exit codes: 0 complete, 1 some data is lost (printed), 2 nothing readable"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("file", type=Path, metavar="FILE", help="a recording (.mcap)")
    about = "file for the clean copy (default: FILE with '.recovered' before its ending)"
    parser.add_argument("-t", "--to", type=Path, metavar="NEW", help=about)
    output_argument(parser)


def execute(options: argparse.Namespace) -> int:
    """Copy a damaged recording; print which share of the data was kept, and the known losses."""
    require("a recovery", ("record",))
    from cloudrc.record.reader import recover

    source: Path = options.file
    target = options.to or source.parent / f"{source.stem}.recovered{source.suffix}"
    if os.path.lexists(target):
        raise BadInputError(f"{target}: already there; name another file with --to")
    recovery = recover(source, target)
    kept = ", ".join(f"{count} {kind}" for kind, count in recovery.kept.items() if count)
    lines = [f"kept {recovery.share:.1%}: {kept}", *(f"lossy: {note}" for note in recovery.notes)]
    if recovery.complete and recovery.index_is_new:
        lines.append("the index was missing or damaged and is rebuilt; nothing is lost")
    text = "\n".join(map(escape, [*lines, str(target)]))
    print_result(options.output, {"file": str(target), **asdict(recovery)}, text)
    return 0 if recovery.complete else LOSSY
