"""What an end records of the link that shapes what it sends: the link's state file in, records out.

The link's process publishes its state whenever it has changed it (`cloudrc/link/state.py`). A look
at the file costs a system call and is made ten times a second.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from math import nan
from pathlib import Path

from cloudrc.link.state import LinkState, from_text
from cloudrc.records import GuardChange, LinkChanged, MissionEvent, Record, SessionOpened

PERIOD_NS = 100_000_000
"""Between two looks [ns]."""
BEGINNINGS = (SessionOpened, GuardChange, MissionEvent)
"""With these a mission begins: a recording that is cut there has to say what the link was."""


class LinkNotes:
    """Follows the file; what cannot be read changes nothing."""

    def __init__(self, path: Path, *, uplink: bool) -> None:
        """Follow the file at `path`, which need not be there yet.

        Args:
            path: State of the link.
            uplink: Which direction this end sends in.
        """
        self._path, self._uplink = path, uplink
        self._seen: tuple[int, int, int] | None = None
        self._state: LinkState | None = None
        self._due_ns = 0

    def after(self, records: Iterable[Record], now_ns: int, slip_ns: int = 0) -> list[Record]:
        """Say what there is to be noted after these records.

        Args:
            records: What the end has just recorded.
            now_ns: The machine's monotonic clock [ns].
            slip_ns: By how much the end's own clock lags [ns].

        Returns:
            One record if the link has changed or a mission may have begun, else none.
        """
        changed = now_ns >= self._due_ns and self._look(now_ns)
        state = self._state
        if state is None or not (changed or any(isinstance(r, BEGINNINGS) for r in records)):
            return []
        return [_note(state, self._uplink, now_ns, slip_ns)]

    def _look(self, now_ns: int) -> bool:
        """Read the file if it is another one; say whether the state has changed."""
        self._due_ns = now_ns + PERIOD_NS
        try:
            status = self._path.stat()
            seen = (status.st_mtime_ns, status.st_ino, status.st_size)
            if seen == self._seen:
                return False
            state, before = from_text(self._path.read_text(encoding="utf-8")), self._state
            self._seen, self._state = seen, state
        except (OSError, ValueError):
            return False
        return before is None or before.since_ns != state.since_ns


def _note(state: LinkState, uplink: bool, now_ns: int, slip_ns: int) -> LinkChanged:
    asked = {key: nan if value is None else float(value) for key, value in state.asked.items()}
    time_line = nan if state.origin_ns is None else (now_ns - state.origin_ns) * 1e-9
    return LinkChanged(
        stamp_ns=now_ns - slip_ns,
        uplink=uplink,
        shaper=state.shaper,
        cause=state.cause,
        age=max(0, now_ns - state.since_ns) * 1e-9,
        time_line=time_line,
        delay=asked.get("delay", nan),
        jitter=asked.get("jitter", nan),
        loss=asked.get("loss", nan),
        rate=asked.get("rate", nan),
        conditions=json.dumps(state.profile.get(state.direction, {})),
    )
