"""Copy what is readable of a damaged recording into a valid file, and say what is lost."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

from cloudrc.errors import BadInputError
from cloudrc.record.columns import Recording
from cloudrc.record.content import Message
from cloudrc.record.reader import LISTED_MAX, UNKNOWN, File, list_some
from cloudrc.record.topics import TOPICS, VIEWS

LOSSY_SHARE_MAX = 0.999
"""Largest value of `Recovery.share` if something is missing [1]."""


@dataclass(slots=True)
class Recovery:
    """What `recover` has saved of a damaged recording, and what is lost."""

    complete: bool  # whether nothing is missing or doubtful
    share: float  # share of the messages that were kept, in [0, 1]; if unknown, of the bytes
    size: int  # size of the damaged file [bytes]
    kept: dict[str, int]  # number of objects in the new file, by kind
    topics: dict[str, int]  # number of messages in the new file, by topic
    derived: list[str]  # topics for viewers that were made again from the other topics
    dropped: dict[str, int | None]  # number of messages that are not in the new file, by topic
    bytes_lost: int  # number of bytes that were not read
    notes: list[str]  # what is missing or doubtful, in words
    remarks: list[str]  # what else was noticed, in words; it does no harm
    index_is_new: bool  # whether the old file had no readable index

    def as_lines(self) -> list[str]:
        """Describe in lines what is in the new file, and what is lost."""
        kept = ", ".join(f"{count} {kind}" for kind, count in self.kept.items() if count)
        lines = [f"kept {self.share:.1%}: {kept}"]
        lines.append(f"topics: {_list(self.topics)}")
        lines += [f"lossy: {note}" for note in self.notes]
        lines += [f"the recording {remark}" for remark in self.remarks]
        if len(self.dropped) > LISTED_MAX:  # the note lists only some
            lines.append(f"dropped: {_list(self.dropped)}")
        if self.derived:
            lines.append(f"made again from the other topics: {', '.join(self.derived)}")
        return lines


def _list(counts: Mapping[str, int | None]) -> str:
    return ", ".join(f"{name} {'?' if n is None else n}" for name, n in counts.items())


def recover(
    source: Path, target: Path, views: Callable[[Recording], list[Message]] | None = None
) -> Recovery:
    """Write a complete copy of a recording that may be torn or damaged.

    The copy contains the topics that cloudrc records, the attachments, the metadata, and a note
    about what is missing. From a damaged recording, `views` makes the topics for viewers again; it
    raises a BadInputError if this is impossible. Raise a BadInputError if the file has no readable
    message, or an OSError if the new file cannot be written.
    """
    file = File(source)
    recording = Recording.of(file.content)
    if not recording.messages:
        reason = "; ".join([*recording.remarks, recording.note]).strip("; ") or "none is in it"
        raise BadInputError(f"{source}: holds no readable message: {reason}; nothing is written")
    notes = [recording.note] if recording.note else []
    derived, missed = _make_views_again(file, recording, views) if views else ([], [])
    if file.unread:
        missed.insert(0, f"{file.unread} bytes after the last intact part were not read")
    if dropped := _dropped(file, recording, derived):
        counts = [f"{'?' if n is None else n} on {topic}" for topic, n in sorted(dropped.items())]
        missed.append(f"messages that are not in the copy: {list_some(counts)}")
    recording.told = "; ".join(filter(None, [recording.told, *missed]))
    recording.write(target)
    notes += missed
    written = _written(recording)
    share = _share(file, written.total(), sum(filter(None, dropped.values())))
    kept = {"messages": written.total(), "attachments": len(recording.attachments)}
    return Recovery(
        complete=not notes,
        share=min(share, LOSSY_SHARE_MAX) if notes else 1.0,
        size=file.size,
        kept={**kept, "topics": len(written)},
        topics=dict(sorted(written.items())),
        derived=derived,
        dropped=dropped,
        bytes_lost=file.unread + file.left_out,
        notes=notes,
        remarks=list(recording.remarks),
        index_is_new=not file.ended,
    )


def _make_views_again(
    file: File, recording: Recording, views: Callable[[Recording], list[Message]]
) -> tuple[list[str], list[str]]:
    """Make the topics for viewers again if messages are lost; return their names, and notes."""
    if not _has_views(file) or not _dropped(file, recording):
        return [], []
    try:
        recording.views = views(recording)
    except BadInputError as error:
        return [], [f"the topics for viewers could not be made again: {error}"]
    return sorted({topic for topic, _, _ in recording.views}), []


def _share(file: File, written: int, lost: int) -> float:
    """Return the share of the messages that were kept, in [0, 1]; if unknown, of the bytes."""
    if lost:
        return written / (written + lost)
    return 1.0 - (file.unread + file.left_out) / file.size


def _has_views(file: File) -> bool:
    """Return whether a file is the recording of a mission, which has topics for viewers."""
    known = {channel.topic for channel in file.channels.values()}
    return bool(known & VIEWS.keys()) or "config.yaml" in file.content.attachments


def _written(recording: Recording) -> Counter[str]:
    return Counter(topic for topic, _, _ in [*recording.messages, *recording.views])


def _dropped(
    file: File, recording: Recording, derived: Collection[str] = ()
) -> dict[str, int | None]:
    """Count the messages that `file` has lost, by topic; None: some, but nobody knows how many.

    `derived` are the topics for viewers that were made again.
    """
    dropped = dict[str, int | None](file.stated - _written(recording))
    dropped |= dict.fromkeys(uncounted := _uncounted(file))
    # Views that were made from all messages are complete, and messages without a topic were views.
    is_made = bool(derived) and not dropped.keys() & TOPICS.keys()
    made = {UNKNOWN, *(uncounted & VIEWS.keys())} if is_made else set()
    return {topic: n for topic, n in sorted(dropped.items()) if topic not in made}


def _uncounted(file: File) -> set[str]:
    """Return the topics that may have lost messages that nobody has counted."""
    if not file.lost or file.statistics:
        return set()
    topics = file.stated.keys() - {UNKNOWN}
    if _has_views(file):
        topics |= VIEWS.keys()
    return topics - TOPICS.keys() if file.has_counts else topics
