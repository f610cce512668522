"""The metrics of one process while it flies: records come in, readings go out."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from cloudrc.exposition.api import Api
from cloudrc.exposition.cloud import CloudEnd
from cloudrc.exposition.end import End
from cloudrc.exposition.labels import CLOUD, LINK, MISSION, TELEOP, WORLD
from cloudrc.exposition.link import Link
from cloudrc.exposition.mission import Mission
from cloudrc.exposition.part import Part, Readings
from cloudrc.exposition.world import WorldEnd
from cloudrc.records import Record


class Live:
    """The values of one role's metrics; one thread feeds it, any other may read it.

    Attributes:
        end: Of the tunnel; None in a process that is none.
        link: The emulated link; None in a process that is none.
    """

    def __init__(self, role: str, *, missions: bool = True) -> None:
        """Begin with nothing seen.

        Args:
            role: "world", "cloud", "teleop" or "link".
            missions: Whether they are told here; False in a cloud whose teleop tells them.
        """
        self.end: End | None = {WORLD: WorldEnd, CLOUD: CloudEnd}.get(role, lambda: None)()
        self.link = Link() if role == LINK else None
        mission = Mission(always=role == TELEOP) if missions and role in MISSION else None
        api = Api() if role == TELEOP else None
        parts: tuple[Part | None, ...] = (self.end, self.link, mission, api)
        self._parts = [part for part in parts if part is not None]
        self._handlers: dict[type, Callable[[Any], None]] = {}
        for part in self._parts:
            self._handlers.update(part.handlers())

    def see(self, records: Iterable[Record]) -> None:
        """Take in records of this process, oldest first; never waits."""
        handlers = self._handlers
        for record in records:
            handle = handlers.get(type(record))
            if handle is not None:
                handle(record)

    def read(self) -> Readings:
        """Say all that is known now; what is not known is absent."""
        readings: Readings = {}
        for part in self._parts:
            readings |= part.read()
        return readings
