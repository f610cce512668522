"""What the journal has not taken yet: entries come in; all reach it, in order, once it can write.

A full disk does not stop a flight: what happens meanwhile waits here, and goes before whatever is
written next. How many can wait is bounded: what tells of a mission's end or of a waypoint reached
stays, and there are no more of them than missions and waypoints; of all else the newest stay.
"""

from __future__ import annotations

from collections.abc import Callable

from cloudrc.cloud.teleop.journal_format import Entry
from cloudrc.cloud.teleop.service_mission import STATES

PASSING_MAX = 1_000
"""Entries that wait at most, those that stay in any case not counted."""
AT_ONCE = 20
"""Entries written at once: each takes the disk its time, and the flight goes on."""


class Backlog:
    """Stands before a journal and forgets nothing that matters."""

    def __init__(self, write: Callable[[Entry], None]) -> None:
        """Begin with nothing.

        Args:
            write: Keeps an entry; raises OSError if it cannot.
        """
        self._write = write
        self._waiting: list[Entry] = []

    def __len__(self) -> int:
        return len(self._waiting)

    def append(self, entry: Entry) -> None:
        """Keep an entry, after all that wait, or not at all.

        Raises:
            OSError: If it is not kept.
        """
        while self._waiting:
            self.flush()
        self._write(entry)

    def note(self, entry: Entry) -> None:
        """Keep an entry, after all that wait, now or later.

        Raises:
            OSError: If the disk refuses; the entry waits then, too.
        """
        self._waiting.append(entry)
        try:
            self.flush()
        finally:
            self._shorten()

    def flush(self) -> None:
        """Write some of what waits, oldest first.

        Raises:
            OSError: If the disk refuses; what is left waits on.
        """
        for _ in range(min(AT_ONCE, len(self._waiting))):
            self._write(self._waiting[0])
            del self._waiting[0]

    def _shorten(self) -> None:
        """Drop the oldest entry that nothing depends on, if there are too many."""
        if len(self._waiting) <= PASSING_MAX:
            return
        passing = [n for n, entry in enumerate(self._waiting) if _passes(entry)]
        if len(passing) > PASSING_MAX:
            newest = {self._waiting[n]["mission"]: n for n in passing if _leads(self._waiting[n])}
            del self._waiting[next(n for n in passing if n not in newest.values())]


def _passes(entry: Entry) -> bool:
    """Whether newer entries of the mission say all that follows from it, but for its state."""
    return entry["event"] != "reached" and "verdict" not in entry


def _leads(entry: Entry) -> bool:
    """Whether it tells the mission's state."""
    return entry["event"] in STATES
