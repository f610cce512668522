"""The robot in its scene, and the simulation clock.

In every tick the simulator gives sensor readings to the onboard part (guard and low-level
controller) and gets four rotor speeds back. Nothing else passes between the two.

World's clock follows the machine's monotonic clock and may fall behind. After a stall the
simulation catches up by at most 50 ms per wake. The rest of the stall is slip: world's clock lags
by the slip from then on. Therefore the guard never skips a tick. A stalled machine makes world
slow, but world's clock never jumps.
"""

from __future__ import annotations

from typing import Protocol

from cloudrc.messages import Command, GuardState, OperatorRequest
from cloudrc.world.guard.state import Guard
from cloudrc.world.low_level import LowLevel
from cloudrc.world.readings import Readings, RotorSpeeds
from cloudrc.world.rotors import STOPPED
from cloudrc.world.simulator import Simulator

STEP_NS = 2_000_000
"""Duration of a tick of physics, low-level controller and guard [ns].
Source: docs/reference/plant.md, "Physics step"."""
STEP = STEP_NS * 1e-9
"""Duration of a tick [s]."""
CATCH_UP_NS = 50_000_000
"""Longest simulated time by which world catches up in one wake of its loop [ns]."""


class SimulationClock:
    """World's clock; `tick_ns` is the next tick to run [ns], `slip_ns` its total lag [ns]."""

    def __init__(self, start_ns: int) -> None:
        """Set world's clock to `start_ns` of the machine's monotonic clock [ns]."""
        self.tick_ns = start_ns
        self.slip_ns = 0

    def follow(self, now_ns: int) -> int:
        """Convert a monotonic time to world time; increase the slip if the wake is over 50 ms late.

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


class Observer(Protocol):
    """Sees what a robot receives and does, and changes nothing. Times are on world's clock [ns]."""

    def see_step(self, now_ns: int, readings: Readings, rotor_speeds: RotorSpeeds) -> None:
        """See a step of the physics that has ended.

        Args:
            now_ns: Beginning of the step.
            readings: Readings at the beginning of the step, the input of the guard's tick.
            rotor_speeds: Commanded rotor speeds [rad/s], shape (4,).
        """

    def see_command(self, command: Command, rejection: str | None, now_ns: int) -> None:
        """See a command after the guard's answer; `rejection` is None for an accepted command."""

    def see_request(self, request: OperatorRequest, now_ns: int) -> None:
        """See an operator request after it was carried out."""

    def see_session(self, now_ns: int) -> None:
        """See a new session begin: earlier commands no longer count."""


class Robot:
    """Runs the ticks of physics, guard and low-level controller.

    Attributes:
        simulator: The physics.
        guard: The guard.
        observers: See every step, command, request and session; called in the order of the list.
    """

    def __init__(self, simulator: Simulator, low_level: LowLevel, guard: Guard) -> None:
        self.simulator = simulator
        self.guard = guard
        self.observers: list[Observer] = []
        self._low_level = low_level

    def put_on_ground(self, now_ns: int, cause: str) -> None:
        """Reset the robot to its spawn, with its rotors stopped."""
        self.simulator.reset()
        self._low_level.reset()
        self.guard.put_on_ground(now_ns, cause)

    def run(self, tick_ns: int, until_ns: int) -> int:
        """Run all ticks from `tick_ns` (included) to `until_ns` (excluded), world's clock.

        Returns:
            The next tick to run [ns].
        """
        simulator, guard, low_level = self.simulator, self.guard, self._low_level
        observers = self.observers
        ticks = range(tick_ns, until_ns, STEP_NS)
        for now_ns in ticks:
            readings = simulator.readings
            reference = guard.step(now_ns, readings, STEP)
            if reference is None:
                low_level.reset()
                speeds = STOPPED
            elif guard.state is TRACK or not guard.brakes:
                speeds = low_level.update(readings, reference)
            else:
                speeds = low_level.brake(readings, reference)
            simulator.step(speeds)
            for observer in observers:
                observer.see_step(now_ns, readings, speeds)
        return tick_ns + len(ticks) * STEP_NS
