"""Out of a long recording the last mission: all that two pods recorded in, one flight out.

A pod outlives its missions and records all of them into one file, which is still open when it is
fetched: that its end is missing is no loss if the mission's own end is there.
"""

from __future__ import annotations

from dataclasses import replace

from cloudrc.record.columns import Recording
from cloudrc.record.merge import Mission
from cloudrc.record.reader import Contents
from cloudrc.record.writer import MISSING

UNDER_WAY = ("started", "reached", "held", "resumed", "goto")
"""Events of a mission that goes on; every other event ends it."""
BEFORE_NS = 1_000_000_000
"""What is kept before a mission starts [ns]: the session and the guard's change that open it."""
AFTER_NS = 2_000_000_000
"""What is kept after a mission's end [ns]."""
CUT_SHORT = "cut short"
"""How the reader's note begins that a file has no end."""


def cut_to_last_mission(mission: Mission) -> tuple[Mission, bool]:
    """Keep the last mission of a recording.

    Args:
        mission: Both ends' recordings, merged.

    Returns:
        The last mission that was started in it, and whether its end is in it.
    """
    contents = mission.contents
    began, ended = _last_mission(contents)
    until = contents.messages[-1][1] if contents.messages else 0
    whole = ended is not None and until > ended
    first = began - BEFORE_NS if began is not None else 0
    last = ended + AFTER_NS if ended is not None else until
    kept = [message for message in contents.messages if first <= message[1] <= last]
    cut = Contents(kept, dict(contents.metadata), contents.attachments, contents.note)
    if whole:
        cut.note = "; ".join(n for n in contents.note.split("; ") if CUT_SHORT not in n)
        cut.metadata.pop(MISSING, None)
        if cut.note:
            cut.metadata[MISSING] = cut.note
    return replace(mission, contents=cut), whole


def _last_mission(contents: Contents) -> tuple[int | None, int | None]:
    """Stamps [ns] of the last mission's start and of its end; None for what is not there."""
    events = [message for message in contents.messages if message[0] == "/mission"]
    table = Recording.from_contents(Contents(events))["/mission"]
    began = ended = None
    for stamp_ns, event in zip(table["stamp_ns"].tolist(), table["event"].tolist(), strict=True):
        if event == "started":
            began, ended = stamp_ns, None
        elif event not in UNDER_WAY and ended is None:
            ended = stamp_ns
        elif event in UNDER_WAY and began is None:
            ended = None  # resumed by a new pod: the start is in the old one's recording
    return began, ended
