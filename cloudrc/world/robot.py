"""The robot: in every step, guard and onboard controller turn readings into commands."""

from __future__ import annotations

from typing import Protocol

from cloudrc.messages import Command, GuardState, OperatorRequest
from cloudrc.sim.onboard import Commands, Onboard
from cloudrc.sim.readings import Readings
from cloudrc.sim.simulator import Simulator
from cloudrc.world.guard.state import Guard
from cloudrc.world.watched import OnboardFailedError

STEP_NS = 2_000_000
"""Duration of one step of physics, onboard controller and guard [ns].
Source: docs/reference/plant.md, "Physics step"."""
STEP = STEP_NS * 1e-9
"""Duration of one step [s]."""
TRACK, ESTOP = GuardState.TRACK, GuardState.ESTOP  # looking up a member of an enum is slow


class Observer(Protocol):
    """Object that a `Robot` informs of its steps and inputs. Times are on world's clock [ns]."""

    def see_step(self, now_ns: int, readings: Readings, commands: Commands) -> None:
        """Observe a physics step that begins at `now_ns` with these readings and commands."""

    def see_command(self, command: Command, rejection: str | None, now_ns: int) -> None:
        """Observe a command and the guard's answer; `rejection` is None if the guard accepts it."""

    def see_request(self, request: OperatorRequest, now_ns: int) -> None:
        """Observe that the robot has carried out an operator request at `now_ns`."""

    def see_session(self, now_ns: int) -> None:
        """Observe that a new session begins; the guard has forgotten all earlier commands."""


class Robot:
    """Runs physics, guard and onboard controller step by step, and informs `observers`.

    Attributes:
        failure: Why the guard stopped the robot, until a caller sets None; None: no failure.
    """

    def __init__(self, simulator: Simulator, onboard: Onboard, guard: Guard) -> None:
        self.simulator = simulator
        self.onboard = onboard
        self.guard = guard
        self.observers: list[Observer] = []
        self.failure: OnboardFailedError | None = None

    def put_on_ground(self, now_ns: int, cause: str) -> None:
        """Reset the robot to its spawn, stopped, and record the reason `cause`."""
        self.guard.put_on_ground(now_ns, cause)
        try:
            self.simulator.reset()
            self.onboard.reset()
        except OnboardFailedError as failure:
            self._fail(failure, now_ns)

    def run(self, tick_ns: int, until_ns: int) -> int:
        """Run steps from `tick_ns` up to `until_ns`; return the time of the next step [ns]."""
        simulator, guard, onboard = self.simulator, self.guard, self.onboard
        observers = self.observers
        ticks = range(tick_ns, until_ns, STEP_NS)
        for now_ns in ticks:
            readings = simulator.readings
            reference = guard.step(now_ns, readings, STEP)
            try:
                if reference is None:
                    onboard.reset()
                    commands = onboard.stopped
                elif guard.state is TRACK or not guard.brakes:
                    commands = onboard.update(readings, reference, guard.yaw_rate)
                else:
                    commands = onboard.brake(readings, reference)
                simulator.step(commands)
            except OnboardFailedError as failure:  # before the physics of this step
                commands = self._step_stopped(failure, now_ns)
            for observer in observers:
                observer.see_step(now_ns, readings, commands)
        return tick_ns + len(ticks) * STEP_NS

    def _step_stopped(self, failure: OnboardFailedError, now_ns: int) -> Commands:
        """Stop the robot because of `failure`, and run the step with stopped actuators."""
        self._fail(failure, now_ns)
        try:
            self.simulator.step(self.onboard.stopped)
        except OnboardFailedError as more:  # only once: then the actuators push nothing
            return self._step_stopped(more, now_ns)
        return self.onboard.stopped

    def _fail(self, failure: OnboardFailedError, now_ns: int) -> None:
        if self.guard.state is not ESTOP:  # a stopped robot may fail in every step
            self.failure, failure.stamp_ns = failure, now_ns
        self.guard.fail(now_ns)
