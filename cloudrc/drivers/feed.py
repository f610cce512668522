"""Send a few records of a process to its supervisor, one line of JSON each.

The process writes the lines to its standard output. Writing never blocks the process: lines that
nobody reads are lost. Prints of plug-ins go to standard error, which is the process's log.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterable
from enum import IntEnum
from typing import Any, get_args, get_origin, get_type_hints

from cloudrc import records as kinds
from cloudrc.records import (
    Control,
    Fault,
    GuardChange,
    LinkChanged,
    MissionEvent,
    Record,
    TelemetrySent,
)

READY = "ready"
"""The line that a process writes when it can receive, and later as a sign of life."""
ALIVE_PERIOD = 1.0
"""Time between two signs of life [s]."""
PERIOD_NS = 100_000_000
"""Shortest time between two sent records of a type in `SAMPLED` [ns]."""
EVENTS = (GuardChange, MissionEvent, Fault, LinkChanged)
"""Record types of which every record is sent."""
SAMPLED = (TelemetrySent, Control)
"""Record types of which at most one record is sent per `PERIOD_NS`."""


class Feed:
    """Sends selected records to a pipe without blocking."""

    def __init__(self, descriptor: int, *, watched: bool = True) -> None:
        """Make the pipe non-blocking.

        Args:
            descriptor: File descriptor of the pipe.
            watched: Whether a supervisor reads the pipe. If nobody does, as in a container, only
                events are written, as lines of a log.
        """
        self._descriptor, self._watched = descriptor, watched
        self._told_ns: dict[type, int] = {}
        self._links: dict[bool, str] = {}
        self._rest = b""  # of a line for which the pipe had too little room
        os.set_blocking(descriptor, False)

    @classmethod
    def on_stdout(cls, *, watched: bool = True) -> Feed:
        """Reserve standard output for the feed; redirect all other prints to standard error."""
        feed = cls(os.dup(1), watched=watched)
        os.dup2(2, 1)
        return feed

    def ready(self) -> None:
        """Write that the process can receive."""
        self._write(READY)

    def alive_while(self, stop: Callable[[], bool]) -> Callable[[], bool]:
        """Wrap the `stop` that a loop calls in every turn: also write signs of life."""
        if not self._watched:
            return stop
        due = 0.0

        def ask() -> bool:
            nonlocal due
            if (now := time.monotonic()) >= due:
                due = now + ALIVE_PERIOD
                self._write(READY)
            return stop()

        return ask

    def tell(self, records: Iterable[Record]) -> None:
        """Send the records that a supervisor wants to see."""
        for record in records:
            if isinstance(record, EVENTS):
                if isinstance(record, LinkChanged) and not self._is_news(record):
                    continue
                self._write(to_line(record) if self._watched else in_words(record))
            elif self._watched and isinstance(record, SAMPLED) and self._due(record):
                self._write(to_line(record))

    def _is_news(self, record: LinkChanged) -> bool:
        """Tell whether a record of the link shows a change.

        `LinkNotes` repeats its record when a mission begins. Each direction is compared with its
        own last record.
        """
        last, self._links[record.uplink] = self._links.get(record.uplink), record.conditions
        return last != record.conditions and bool(record.cause)

    def _due(self, record: Record) -> bool:
        last_ns = self._told_ns.get(type(record))
        if last_ns is not None and record.stamp_ns - last_ns < PERIOD_NS:
            return False
        self._told_ns[type(record)] = record.stamp_ns
        return True

    def _write(self, line: str) -> None:
        """Write a whole line or drop the line; the rest of a partly written line comes first."""
        data = line.encode(errors="backslashreplace") + b"\n"
        try:
            self._rest = self._rest[os.write(self._descriptor, self._rest) :]
            if not self._rest:
                self._rest = data[os.write(self._descriptor, data) :]
        except OSError:  # full or closed: the flight continues without the feed
            pass


def to_line(record: Record) -> str:
    """Format a record as one line of JSON: the name of its type, then its fields in order."""
    return json.dumps([type(record).__name__, record])


def in_words(event: GuardChange | MissionEvent | Fault | LinkChanged) -> str:
    """Describe an event for a log or a screen."""
    if isinstance(event, GuardChange):
        return f"guard: {event.state.name}, {event.cause}"
    if isinstance(event, LinkChanged):
        way = "uplink" if event.uplink else "downlink"
        jitter = f" ± {event.jitter * 1e3:g}" if event.jitter else ""
        loss = f", loss {event.loss * 100:.3g} %" if event.loss else ""
        return f"link: {way} {event.delay * 1e3:g}{jitter} ms{loss} ({event.cause})"
    return event.text


def from_line(line: str) -> Record:
    """Parse a record from its line.

    Raises:
        ValueError: If the line is not a record.
    """
    try:
        name, values = json.loads(line)
        kind = getattr(kinds, name)
        if kind not in get_args(Record):
            raise ValueError(name)
        record: Record = _from_json(kind, values)
    except (TypeError, AttributeError, ValueError, RecursionError) as error:
        raise ValueError(f"not a record: {line!r}") from error
    return record


def _from_json(kind: Any, value: Any) -> Any:
    """Convert a JSON value to the type `kind`."""
    if hasattr(kind, "_fields"):
        hints = get_type_hints(kind)
        fields = zip(kind._fields, value, strict=True)
        return kind(*[_from_json(hints[name], item) for name, item in fields])
    if get_origin(kind) is tuple:
        return tuple(value)
    return kind(value) if isinstance(kind, type) and issubclass(kind, IntEnum) else value
