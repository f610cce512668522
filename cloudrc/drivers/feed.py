"""What a process tells the one that started it: a few of its records, one line of JSON each.

A process in flight writes lines to its standard output, which must never block it: if nobody reads
them they are lost. The supervisor makes records of them again. What a plug-in prints must not get
among them: it goes to standard error, that is to the process's log.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
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
"""The line that a process writes once it can receive."""
PERIOD_NS = 100_000_000
EVENTS = (GuardChange, MissionEvent, Fault, LinkChanged)
"""Every one of these is told."""
SAMPLED = (TelemetrySent, Control)
"""Of these one every 100 ms."""


class Feed:
    """The telling end: picks records and writes them to a pipe that does not block."""

    def __init__(self, descriptor: int, *, watched: bool = True) -> None:
        """Begin.

        Args:
            descriptor: Where to write.
            watched: Whether a supervisor reads it. Where none does, as in a container, what is
                written becomes a log: the events alone, in words.
        """
        self._descriptor, self._watched = descriptor, watched
        self._told_ns: dict[type, int] = {}
        self._links: dict[bool, str] = {}
        self._rest = b""  # of a line that was longer than the pipe had room for
        os.set_blocking(descriptor, False)

    @classmethod
    def on_stdout(cls, *, watched: bool = True) -> Feed:
        """Keep standard output for the feed alone; whoever prints writes to standard error now."""
        feed = cls(os.dup(1), watched=watched)
        os.dup2(2, 1)
        return feed

    def ready(self) -> None:
        """Say that the process can receive."""
        self._write(READY)

    def tell(self, records: Iterable[Record]) -> None:
        """Tell those of the records that somebody who watches wants to see."""
        for record in records:
            if isinstance(record, EVENTS):
                if isinstance(record, LinkChanged) and not self._is_news(record):
                    continue
                self._write(to_line(record) if self._watched else in_words(record))
            elif self._watched and isinstance(record, SAMPLED) and self._due(record):
                self._write(to_line(record))

    def _is_news(self, record: LinkChanged) -> bool:
        """Tell a change of the link from one that is noted again because a mission begins.

        A change of the other direction, which is recorded here, too, is no news of this one.
        """
        told, self._links[record.uplink] = self._links.get(record.uplink), record.conditions
        return told != record.conditions and bool(record.cause)

    def _due(self, record: Record) -> bool:
        last_ns = self._told_ns.get(type(record))
        if last_ns is not None and record.stamp_ns - last_ns < PERIOD_NS:
            return False
        self._told_ns[type(record)] = record.stamp_ns
        return True

    def _write(self, line: str) -> None:
        """Write a line, or lose it whole: what is left of a longer one goes before the next."""
        data = line.encode(errors="backslashreplace") + b"\n"
        try:
            self._rest = self._rest[os.write(self._descriptor, self._rest) :]
            if not self._rest:
                self._rest = data[os.write(self._descriptor, data) :]
        except OSError:  # full or closed: to watch is a courtesy, to fly is not
            pass


def to_line(record: Record) -> str:
    """Write a record as one line of JSON: the name of its type, then its fields in order."""
    return json.dumps([type(record).__name__, record])


def in_words(event: GuardChange | MissionEvent | Fault | LinkChanged) -> str:
    """Say what has happened, for a log or a screen."""
    if isinstance(event, GuardChange):
        return f"guard: {event.state.name}, {event.cause}"
    if isinstance(event, LinkChanged):
        way = "uplink" if event.uplink else "downlink"
        jitter = f" ± {event.jitter * 1e3:g}" if event.jitter else ""
        loss = f", loss {event.loss * 100:.3g} %" if event.loss else ""
        return f"link: {way} {event.delay * 1e3:g}{jitter} ms{loss} ({event.cause})"
    return event.text


def from_line(line: str) -> Record:
    """Read a record from its line.

    Raises:
        ValueError: If it is not one.
    """
    try:
        name, values = json.loads(line)
        kind = getattr(kinds, name)
        if kind not in get_args(Record):
            raise ValueError(name)
        record: Record = _build(kind, values)
    except (TypeError, AttributeError, ValueError, RecursionError) as error:
        raise ValueError(f"not a record: {line!r}") from error
    return record


def _build(kind: Any, value: Any) -> Any:
    """Make a value of this type from what JSON has for it."""
    if hasattr(kind, "_fields"):
        hints = get_type_hints(kind)
        fields = zip(kind._fields, value, strict=True)
        return kind(*[_build(hints[name], item) for name, item in fields])
    if get_origin(kind) is tuple:
        return tuple(value)
    return kind(value) if isinstance(kind, type) and issubclass(kind, IntEnum) else value
