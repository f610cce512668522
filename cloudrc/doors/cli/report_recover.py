# SPDX-License-Identifier: Apache-2.0

"""`cloudrc report --recover`: copy torn recordings, up to the damage, into valid files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from cloudrc.base.errors import BadInputError
from cloudrc.base.outside.paths import check_new, check_there
from cloudrc.base.text import escape
from cloudrc.doors.cli.output import print_result
from cloudrc.doors.cli.parser import Options

ENDS = "world.mcap", "cloud.mcap"
"""Recordings of a run that has no mission.mcap yet."""


def recover(options: Options) -> None:
    """Copy the recordings; print what is in each copy, and what is missing."""
    sources = _recordings(options.run)
    if options.to and len(sources) > 1:
        names = " and ".join(source.name for source in sources)
        raise BadInputError(
            f"--to: names one file, and {options.run} has {names}; name one of them"
        )
    targets = [
        options.to or source.with_name(f"{source.stem}.recovered{source.suffix}")
        for source in sources
    ]
    for target in targets:
        check_new(target, "name another file with --to")
    found = [_copy(*each) for each in zip(sources, targets, strict=True)]
    text = "\n".join(escape(line) for each in found for line in _as_lines(each))
    print_result(options.output, {"recordings": found}, text)


def _recordings(run: Path) -> list[Path]:
    """Return the recordings of a run that has ended: its folder, or one MCAP file."""
    from cloudrc.results.report.folder import check_ended

    check_ended(run if run.is_dir() else run.resolve().parent)
    if not run.is_dir():
        check_there(run, "name the folder of a run, or a file")
        return [run]
    merged = run / "mission.mcap"
    ends = [run / name for name in ENDS if (run / name).is_file()]
    if merged.is_file() or not ends:
        check_there(merged, "name the folder of a run, or a file")
        return [merged]
    return ends


def _copy(source: Path, target: Path) -> dict[str, Any]:
    """Copy what is readable of a recording; return what is in the copy, and what is missing."""
    from cloudrc.doors.cli.progress import Progress
    from cloudrc.results.record.columns import Recording

    with Progress(f"copies what is readable of {source}"):
        recording = Recording.read(source)
        if not recording.messages:
            reason = "; ".join([*recording.remarks, recording.note]).strip("; ") or "none is in it"
            raise BadInputError(f"{source}: holds no readable message: {reason}")
        recording.write(target)
    topics = Counter(topic for topic, _, _ in [*recording.messages, *recording.views])
    return {
        "file": str(target),
        "complete": not recording.note,
        "size": source.stat().st_size,
        "bytes_lost": recording.unread,
        "kept": {
            "messages": topics.total(),
            "attachments": len(recording.attachments),
            "topics": len(topics),
        },
        "topics": dict(sorted(topics.items())),
        "notes": [recording.note] if recording.note else [],
        "remarks": list(recording.remarks),
    }


def _as_lines(found: dict[str, Any]) -> Iterator[str]:
    kept = {kind: found["kept"][kind] for kind in ("messages", "attachments")}
    yield "kept " + ", ".join(f"{count} {kind}" for kind, count in kept.items() if count)
    yield "topics: " + ", ".join(f"{name} {count}" for name, count in found["topics"].items())
    yield from (f"missing: {note}" for note in found["notes"])
    yield from (f"the recording {remark}" for remark in found["remarks"])
    yield found["file"]
