"""World's clock: simulation time that follows the machine's monotonic clock and can fall behind.

Monotonic instants come in; world time goes out. After a stall the simulation catches up at most
50 ms per wake; the rest is slip, and world's clock lags by it from then on. So the guard never
skips a tick, and a stalled machine gives a slow world, not a jumping one.
"""

from __future__ import annotations

STEP_NS = 2_000_000
"""One tick of physics, low-level controller and guard [ns].
Source: docs/reference/plant.md, "Physics step"."""
STEP = STEP_NS * 1e-9
"""The same [s]."""
CATCH_UP_NS = 50_000_000
"""The most that is caught up in one wake [ns]."""


class SimulationClock:
    """Counts ticks; `tick_ns` is the next one to be run."""

    def __init__(self, start_ns: int) -> None:
        """Start at `start_ns` of the machine's monotonic clock [ns]."""
        self.tick_ns = start_ns
        self.slip_ns = 0

    def follow(self, now_ns: int) -> int:
        """Convert a monotonic instant to world time, slipping if too much was missed.

        Args:
            now_ns: The machine's monotonic clock [ns].

        Returns:
            World time [ns]; at most 50 ms after the next tick.
        """
        excess = now_ns - self.slip_ns - self.tick_ns - CATCH_UP_NS
        if excess > 0:
            self.slip_ns += excess
        return now_ns - self.slip_ns
