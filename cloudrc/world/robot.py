"""The robot in its surroundings: physics and the onboard part, joined by one narrow interface.

Sensor readings go from the simulator to the onboard part (guard and low-level controller), four
rotor speeds go back, once per tick. Nothing else passes between the two.

World's clock: simulation time that follows the machine's monotonic clock and can fall behind.

Monotonic instants come in; world time goes out. After a stall the simulation catches up at most
50 ms per wake; the rest is slip, and world's clock lags by it from then on. So the guard never
skips a tick, and a stalled machine gives a slow world, not a jumping one.
"""

from __future__ import annotations

from cloudrc.messages import GuardState
from cloudrc.world.guard.state import Guard
from cloudrc.world.low_level import LowLevel
from cloudrc.world.rotors import STOPPED
from cloudrc.world.simulator import Simulator

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


TRACK = GuardState.TRACK  # an enum's member is slow to look up


class Robot:
    """Runs the ticks of physics, guard and low-level controller."""

    def __init__(self, simulator: Simulator, low_level: LowLevel, guard: Guard) -> None:
        self.simulator = simulator
        self.guard = guard
        self._low_level = low_level

    def put_on_ground(self, now_ns: int, cause: str) -> None:
        """Put the robot back to its spawn, rotors stopped, nothing remembered."""
        self.simulator.reset()
        self._low_level.reset()
        self.guard.put_on_ground(now_ns, cause)

    def run(self, tick_ns: int, until_ns: int) -> int:
        """Run all ticks from `tick_ns` on that are before `until_ns`.

        Returns:
            The first tick that has not been run [ns, world's clock].
        """
        simulator, guard, low_level = self.simulator, self.guard, self._low_level
        ticks = range(tick_ns, until_ns, STEP_NS)
        for now_ns in ticks:
            readings = simulator.readings
            reference = guard.tick(now_ns, readings, STEP)
            if reference is None:
                low_level.reset()
                simulator.step(STOPPED)
            elif guard.state is TRACK or not guard.brakes:
                simulator.step(low_level.update(readings, reference))
            else:
                simulator.step(low_level.brake(readings, reference))
        return tick_ns + len(ticks) * STEP_NS
