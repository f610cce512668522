# SPDX-License-Identifier: Apache-2.0

"""`cloudrc recover FILE`: copy a torn or damaged recording, up to the damage, into a valid file."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from cloudrc.base.errors import BadInputError
from cloudrc.base.outside.paths import check_new
from cloudrc.base.text import escape
from cloudrc.doors.cli.output import output_argument, print_result
from cloudrc.doors.cli.parser import Options, Parser

EPILOG = """\
examples:
  cloudrc recover runs/latest/world.mcap
  cloudrc recover torn.mcap --to clean.mcap -o json

exit codes: 0 copied, and what is missing is printed, 2 nothing readable, or
  still in flight"""


def arguments(parser: Parser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("file", type=Path, metavar="FILE", help="a recording (.mcap)")
    about = "file for the clean copy (default: FILE with '.recovered' before its ending)"
    parser.add_argument("-t", "--to", type=Path, metavar="NEW", help=about)
    output_argument(parser)


def execute(options: Options) -> None:
    """Copy a recording; print what is in the copy, and what is missing."""
    from cloudrc.doors.cli.progress import Progress
    from cloudrc.results.record.columns import Recording
    from cloudrc.results.report.folder import check_ended

    source: Path = options.file
    check_ended(source.resolve().parent)
    target = options.to or source.parent / f"{source.stem}.recovered{source.suffix}"
    check_new(target, "name another file with --to")
    with Progress(f"copies what is readable of {source}"):
        recording = Recording.read(source)
        if not recording.messages:
            reason = "; ".join([*recording.remarks, recording.note]).strip("; ") or "none is in it"
            raise BadInputError(f"{source}: holds no readable message: {reason}")
        recording.write(target)
    topics = Counter(topic for topic, _, _ in [*recording.messages, *recording.views])
    kept = {"messages": topics.total(), "attachments": len(recording.attachments)}
    found = {
        "file": str(target),
        "complete": not recording.note,
        "size": source.stat().st_size,
        "bytes_lost": recording.unread,
        "kept": {**kept, "topics": len(topics)},
        "topics": dict(sorted(topics.items())),
        "notes": [recording.note] if recording.note else [],
        "remarks": list(recording.remarks),
    }
    lines = ["kept " + ", ".join(f"{count} {kind}" for kind, count in kept.items() if count)]
    lines.append("topics: " + ", ".join(f"{name} {n}" for name, n in sorted(topics.items())))
    if recording.note:
        lines.append(f"missing: {recording.note}")
    lines += [f"the recording {remark}" for remark in recording.remarks]
    print_result(options.output, found, "\n".join(map(escape, [*lines, str(target)])))
