"""How late the link's relays were while probes flew: asked all along, the worst is kept.

A relay tells of its last ten seconds only, and one that starves early may be well again at the end.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import replace
from typing import Protocol, Self

from cloudrc.link.verify.causes import Evidence, of_metrics, samples

PERIOD = 4.0
"""Between two questions [s]; each answer is of the ten seconds before."""
_UNKNOWN = Evidence()


class Told(Protocol):
    """Who tells how late it is: see `Shaping`."""

    def metrics(self) -> str:
        """What it counts, in Prometheus' text; "" if it does not answer."""
        ...


class LateWatch:
    """Asks both directions' relays on a thread of its own while it is entered."""

    def __init__(self, running: Mapping[str, Told], period: float = PERIOD) -> None:
        """Set up for the shapers of both directions; one question per `period` [s]."""
        self._running, self._period = running, period
        self._late: dict[str, float] = {}
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._ask_on, name="late", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *failure: object) -> None:
        self._over.set()
        self._thread.join(self._period)

    def look(self) -> None:
        """Ask once."""
        for way, one in self._running.items():
            late = of_metrics(samples(one.metrics()), 0, _UNKNOWN).late
            if late is not None:
                self._late[way] = max(late, self._late.get(way, 0.0))

    def worst(self, way: str, told: Evidence) -> Evidence:
        """Put the worst of a direction in place of what it tells at the end."""
        known = [late for late in (told.late, self._late.get(way)) if late is not None]
        return replace(told, late=max(known, default=None))

    def _ask_on(self) -> None:
        while not self._over.wait(self._period):
            self.look()
