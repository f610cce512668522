"""The robot in its surroundings: physics and the onboard part, joined by one narrow interface.

Sensor readings go from the simulator to the onboard part (guard and low-level controller), four
rotor speeds go back, once per tick. Nothing else passes between the two.
"""

from __future__ import annotations

from cloudrc.messages import GuardState
from cloudrc.world.clock import STEP, STEP_NS
from cloudrc.world.guard import Guard
from cloudrc.world.low_level import LowLevel
from cloudrc.world.rotors import STOPPED
from cloudrc.world.simulator import Simulator

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
