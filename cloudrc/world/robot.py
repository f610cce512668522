"""The robot in its scene, and the simulation clock.

In every tick the simulator gives sensor readings to the onboard part (guard and low-level
controller) and gets four rotor speeds back. Nothing else passes between the two.

World's clock follows the machine's monotonic clock and may fall behind. After a stall the
simulation catches up by at most 50 ms per wake; the rest is slip, and world's clock lags by it from
then on. The guard therefore never skips a tick: a stalled machine makes world slow but never jump.
"""

from __future__ import annotations

from cloudrc.messages import GuardState
from cloudrc.world.guard.state import Guard
from cloudrc.world.low_level import LowLevel
from cloudrc.world.rotors import STOPPED
from cloudrc.world.simulator import Simulator

STEP_NS = 2_000_000
"""Duration of a tick of physics, low-level controller and guard [ns].
Source: docs/reference/plant.md, "Physics step"."""
STEP = STEP_NS * 1e-9
"""Duration of a tick [s]."""
CATCH_UP_NS = 50_000_000
"""Longest simulated time that world catches up in one wake of its loop [ns]."""


class SimulationClock:
    """World's clock; `tick_ns` is the next tick to run [ns], `slip_ns` its total lag [ns]."""

    def __init__(self, start_ns: int) -> None:
        """Start at `start_ns` of the machine's monotonic clock [ns]."""
        self.tick_ns = start_ns
        self.slip_ns = 0

    def follow(self, now_ns: int) -> int:
        """Convert a monotonic time to world time; slip if more than 50 ms were missed.

        Args:
            now_ns: The machine's monotonic clock [ns].

        Returns:
            World time [ns], at most 50 ms after the next tick.
        """
        excess = now_ns - self.slip_ns - self.tick_ns - CATCH_UP_NS
        if excess > 0:
            self.slip_ns += excess
        return now_ns - self.slip_ns


TRACK = GuardState.TRACK  # looking up a member of an enum is slow


class Robot:
    """Runs the ticks of physics, guard and low-level controller."""

    def __init__(self, simulator: Simulator, low_level: LowLevel, guard: Guard) -> None:
        self.simulator = simulator
        self.guard = guard
        self._low_level = low_level

    def put_on_ground(self, now_ns: int, cause: str) -> None:
        """Reset the robot to its spawn, with its rotors stopped."""
        self.simulator.reset()
        self._low_level.reset()
        self.guard.put_on_ground(now_ns, cause)

    def run(self, tick_ns: int, until_ns: int) -> int:
        """Run all ticks from `tick_ns` to before `until_ns`, world's clock.

        Returns:
            The next tick to run [ns].
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
