"""Steps of the machine's wall clock, for people: nothing that flies may look at it.

It is seen against the clock that counts since boot, which nobody sets and which, unlike the
monotonic one, goes on while the machine sleeps.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

STEP = 0.1
"""A smaller difference between two looks is no step [s]."""
DRIFT_MAX = 1e-3
"""By which the two clocks may differ in speed: kernels slew by half of it at most."""
_SINCE_BOOT = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)  # the former: Linux


class WallClock:
    """Counts how often the wall clock was found to have been set, and says so each time."""

    def __init__(self, say: Callable[[str], None] = lambda line: None) -> None:
        """Take it as it is now.

        Args:
            say: Gets one line for each step, from the thread that looks.
        """
        self._say = say
        self._lock = threading.Lock()  # two may scrape at once
        self._wall, self._boot = _now()
        self._steps = 0

    def steps(self) -> int:
        """Look again; say how often it has been set so far, as far as anybody has looked."""
        with self._lock:
            wall, boot = _now()
            passed, seemed = boot - self._boot, wall - self._wall
            if abs(seemed - passed) > STEP + DRIFT_MAX * passed:
                self._steps += 1
                self._say(
                    f"wall clock stepped by {seemed - passed:+.1f} s: the flight does not notice;"
                    " times of day before and after it do not compare"
                )
            self._wall, self._boot = wall, boot
            return self._steps


def _now() -> tuple[float, float]:
    """The wall clock, and the one that counts since boot [s]."""
    return time.time(), time.clock_gettime(_SINCE_BOOT)
