"""`cloudrc recover FILE`: copy what is readable of a damaged recording into a valid file."""

from __future__ import annotations

import argparse
import os
import sys
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from shlex import quote

from cloudrc.cli.output import output_argument, print_result
from cloudrc.errors import BadInputError
from cloudrc.runs.requirements import require
from cloudrc.text import escape

LOSSY = 1
"""Exit code if the copy lacks data of the recording."""
READ_BY_REPORT = ("mission.mcap", "world.mcap", "cloud.mcap")
"""Files of a run that `cloudrc report` reads."""
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
    lines = [*recovery.as_lines(), str(target), *_next_steps(source, target)]
    text = "\n".join(map(escape, lines))
    print_result(options.output, {"file": str(target), **asdict(recovery)}, text)
    return 0 if recovery.complete else LOSSY


def _next_steps(source: Path, target: Path) -> list[str]:
    """Return the line that puts the copy in place of a run's damaged file; none for other files."""
    run = source.parent
    if source.name not in READ_BY_REPORT or not (run / "config.yaml").is_file():
        return []
    old, aside, new = (quote(str(path)) for path in (source, f"{source}.damaged", target))
    return [
        f"to report on it: mv {old} {aside} && mv {new} {old} && cloudrc report {quote(str(run))}"
    ]
