"""What an end records of the link that shapes what it sends: the link's state file in, records out.

The link's process publishes its state whenever it has changed it (`cloudrc/link/state.py`). A look
at the file costs a system call and is made ten times a second. How late a relay's datagrams left is
in a file beside it, and noted every other second. The link's process is not trusted: whatever its
files hold, the loop goes on.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from math import nan
from pathlib import Path

from cloudrc.errors import in_one_line
from cloudrc.files import TooLongError, read, version
from cloudrc.link.state import RELEASED, RELEASED_SUFFIX, STATE_MAX, LinkState, from_text
from cloudrc.records import Counted, GuardChange, LinkChanged, MissionEvent, Record, SessionOpened

PERIOD_NS = 100_000_000
"""Between two looks [ns]."""
RELEASED_PERIOD_NS = 2_000_000_000
"""Between two notes of how late datagrams left [ns]."""
BEGINNINGS = frozenset({SessionOpened, GuardChange, MissionEvent})
"""With these a mission begins: a recording that is cut there has to say what the link was."""
NONSENSE = (OSError, ValueError, TypeError, AttributeError, OverflowError, RecursionError)
"""What comes of a file that cannot be read, or in which stands what nobody would write."""


class LinkNotes:
    """Follows the file; what cannot be read changes nothing, what is too long is not noted."""

    def __init__(self, path: Path, *, uplink: bool) -> None:
        """Follow the file at `path`, which need not be there yet.

        Args:
            path: State of the link.
            uplink: Which direction this end sends in.
        """
        self._path, self._place, self._uplink = path, str(path), uplink
        self._seen: tuple[int, int, int] | None = None
        self._since_ns: int | None = None
        self._note: LinkChanged | None = None
        self._released = path.with_suffix(RELEASED_SUFFIX)
        self._due_ns = self._released_ns = self._noted_ns = 0

    def after(self, records: Iterable[Record], now_ns: int, slip_ns: int = 0) -> list[Record]:
        """Say what there is to be noted after these records.

        Args:
            records: What the end has just recorded.
            now_ns: The machine's monotonic clock [ns].
            slip_ns: By how much the end's own clock lags [ns].

        Returns:
            One record if the link has changed or a mission may have begun; now and then those of
            how late a relay is.
        """
        if now_ns >= self._released_ns:
            self._released_ns = now_ns + RELEASED_PERIOD_NS
            return self._changed(records, now_ns, slip_ns) + self._late(now_ns - slip_ns)
        return self._changed(records, now_ns, slip_ns)

    def _changed(self, records: Iterable[Record], now_ns: int, slip_ns: int) -> list[Record]:
        changed = now_ns >= self._due_ns and self._look(now_ns)
        if not changed and BEGINNINGS.isdisjoint(map(type, records)):
            return []
        note, later = self._note, (now_ns - self._noted_ns) * 1e-9
        if note is None:
            return []
        age, time_line = note.age + later, note.time_line + later
        return [note._replace(stamp_ns=now_ns - slip_ns, age=age, time_line=time_line)]

    def _late(self, stamp_ns: int) -> list[Record]:
        """Say how late datagrams left since the relay began; nothing where none does."""
        try:
            told = json.loads(read(self._released, STATE_MAX))
            counts = {name: int(n) for name, n in told.items() if name in RELEASED}
        except NONSENSE:
            return []
        way = "uplink" if self._uplink else "downlink"
        return [Counted(stamp_ns, "link", f"{way}_{name}", n) for name, n in counts.items()]

    def _look(self, now_ns: int) -> bool:
        """Read the file if it is another one; say whether the state has changed."""
        self._due_ns = now_ns + PERIOD_NS
        seen = version(self._place)
        if seen == self._seen:
            return False
        self._seen = seen  # nonsense stays nonsense until it is another file
        try:
            state = from_text(read(self._path, STATE_MAX).decode())
            self._note = _note(state, self._uplink, now_ns)
        except TooLongError:  # a long time line is in force, and nothing that was noted before
            self._note = self._since_ns = None
            return False
        except NONSENSE:
            return False
        before_ns, self._since_ns = self._since_ns, state.since_ns
        self._noted_ns = now_ns
        return before_ns != state.since_ns


def _note(state: LinkState, uplink: bool, now_ns: int) -> LinkChanged:
    asked = {key: nan if value is None else float(value) for key, value in state.asked.items()}
    time_line = nan if state.origin_ns is None else (now_ns - state.origin_ns) * 1e-9
    return LinkChanged(
        stamp_ns=now_ns,
        uplink=uplink,
        shaper=in_one_line(state.shaper),
        cause=in_one_line(state.cause),
        age=max(0, now_ns - state.since_ns) * 1e-9,
        time_line=time_line,
        delay=asked.get("delay", nan),
        jitter=asked.get("jitter", nan),
        loss=asked.get("loss", nan),
        rate=asked.get("rate", nan),
        conditions=json.dumps(state.profile.get(state.direction, {})),
    )
