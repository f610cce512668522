"""Steps of the machine's wall clock, for people: nothing that flies may look at it.

It is seen against the clock that counts since boot, which nobody sets and which, unlike the
monotonic one, goes on while the machine sleeps. The thread of the recording looks; what an end
records of it is a fault with the size of the step.
"""

from __future__ import annotations

import time

from cloudrc.exposition.ends import CLOCK_SET
from cloudrc.records import Fault

STEP = 0.1
"""A smaller difference between two looks is no step [s]."""
DRIFT_MAX = 1e-3
"""By which the two clocks may differ in speed: kernels slew by half of it at most."""
_SINCE_BOOT = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)  # the former: Linux


class WallClock:
    """Finds out that the wall clock was set."""

    def __init__(self) -> None:
        """Take it as it is now."""
        self._wall, self._boot = _now()

    def step(self) -> float:
        """Look again; say by how much it was set since the look before [s], 0 if it was not."""
        wall, boot = _now()
        passed, seemed = boot - self._boot, wall - self._wall
        self._wall, self._boot = wall, boot
        return seemed - passed if abs(seemed - passed) > STEP + DRIFT_MAX * passed else 0.0


def told(step: float, stamp_ns: int) -> Fault:
    """Make what is recorded of a step.

    Args:
        step: By how much it was set [s].
        stamp_ns: When that was noticed [ns], own clock of the end.
    """
    text = (
        f"wall clock stepped by {step:+.1f} s: the flight does not notice;"
        " times of day before and after it do not compare"
    )
    return Fault(stamp_ns, CLOCK_SET, text)


def _now() -> tuple[float, float]:
    """The wall clock, and the one that counts since boot [s], with no stall in between."""
    while True:
        before, wall = time.clock_gettime(_SINCE_BOOT), time.time()
        boot = time.clock_gettime(_SINCE_BOOT)
        if boot - before < STEP / 2.0:
            return wall, boot
