"""A wall clock that jumps: nobody in the loop may look at it, so nothing may come of it.

A process that starts asks it once, how old its key file is: in the random search this is what its
steps reach, since nothing else in a flight of virtual time has a wall clock.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import cycle

EPOCHS = (0.0, 3600.0, -3600.0, 4_291_747_200.0, 1e-3, 1.7e9)
"""1970, an hour on and back, 2106, and the present [s]."""


TAKE_OFF = 1.7e9
"""When a flight in virtual time begins, by a wall clock that is right [s since 1970]."""


class Wall:
    """A wall clock that somebody sets.

    Attributes:
        offset: By how much it is wrong [s].
    """

    offset = 0.0

    def at(self, now_ns: int) -> float:
        """What it shows at an instant [ns] of virtual time [s since 1970]."""
        return TAKE_OFF + now_ns * 1e-9 + self.offset

    def step(self, by: float) -> None:
        """Set it forward, or back.

        Args:
            by: How much [s].
        """
        self.offset += by


@contextmanager
def steppable_wall_clock() -> Iterator[Wall]:
    """Let `time.time` and `time.time_ns` be as wrong as the clock that is given out."""
    wall, (true, true_ns) = Wall(), (time.time, time.time_ns)
    time.time = lambda: true() + wall.offset
    time.time_ns = lambda: true_ns() + int(wall.offset * 1e9)
    try:
        yield wall
    finally:
        time.time, time.time_ns = true, true_ns


@contextmanager
def jumping_wall_clock() -> Iterator[None]:
    """Let `time.time` and `time.time_ns` say something else at every call."""
    shown = cycle(EPOCHS)
    true = time.time, time.time_ns
    time.time = lambda: next(shown)
    time.time_ns = lambda: int(next(shown) * 1e9)
    try:
        yield
    finally:
        time.time, time.time_ns = true
