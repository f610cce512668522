"""The robot: in every step, guard and onboard controller turn readings into commands."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from cloudrc.errors import describe_error
from cloudrc.messages import Command, GuardState, OperatorRequest, Vector
from cloudrc.outside.code import FAILURES, check_failure, locate, stack_of
from cloudrc.outside.values import RESULT, InvalidValueError
from cloudrc.records import Fault
from cloudrc.sim.onboard import Commands, Onboard
from cloudrc.sim.readings import Readings
from cloudrc.sim.simulator import Simulator
from cloudrc.world.guard.state import Guard

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

    Onboard controller and actuators may be code of a user. If it fails in flight, the guard stops
    the robot.

    Attributes:
        failure: Why the guard stopped the robot, until a caller sets None; None: no failure.
    """

    def __init__(
        self, simulator: Simulator, onboard: Onboard, guard: Guard, name: str = ""
    ) -> None:
        """Connect the parts; `name` is that of a user's onboard controller, which is judged."""
        self.simulator, self.onboard, self.guard = simulator, onboard, guard
        self.observers: list[Observer] = []
        self.failure: Fault | None = None
        self._name, self._size = name, len(onboard.stopped)
        self._update, self._brake = onboard.update, onboard.brake

    def put_on_ground(self, now_ns: int, cause: str) -> None:
        """Reset the robot to its spawn, stopped, and record the reason `cause`."""
        self.guard.put_on_ground(now_ns, cause)
        try:
            self.simulator.reset()
            self.onboard.reset()
        except FAILURES as error:
            self._fail(error, now_ns)

    def steer(
        self, readings: Readings, velocity: Vector, yaw_rate: float, *, brakes: bool = False
    ) -> Commands:
        """Return the onboard controller's commands for a velocity [m/s] and a yaw rate [rad/s].

        `brakes` tells whether the robot brakes to this velocity.
        """
        if brakes:
            commands = self._brake(readings, velocity)
        else:
            commands = self._update(readings, velocity, yaw_rate)
        return RESULT.row(commands, self._size, "result") if self._name else commands

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
                else:
                    brakes = guard.state is not TRACK and guard.brakes
                    commands = self.steer(readings, reference, guard.yaw_rate, brakes=brakes)
                simulator.step(commands)
            except FAILURES as error:  # before the physics of this step
                commands = self._step_stopped(error, now_ns)
            for observer in observers:
                observer.see_step(now_ns, readings, commands)
        return tick_ns + len(ticks) * STEP_NS

    def _step_stopped(self, error: BaseException, now_ns: int) -> Commands:
        """Stop the robot because of `error`, and run the step with stopped actuators."""
        self._fail(error, now_ns)
        try:
            self.simulator.step(self.onboard.stopped)
        except FAILURES:  # the actuators fail
            self.simulator.step(None)
        return self.onboard.stopped

    def _fail(self, error: BaseException, now_ns: int) -> None:
        """Let the guard stop the robot because of `error` in the code of a user."""
        check_failure(error, "the onboard controller")
        if self.guard.state is not ESTOP:  # a stopped robot may fail in every step
            place = self._name if isinstance(error, InvalidValueError) else locate(error)
            what = f"the onboard controller failed ({describe_error(error)}, {place})"
            text = f"{what}; the guard stopped the robot; fix the file"
            self.failure = Fault(now_ns, "onboard_failed", text, stack_of(error))
        self.guard.fail(now_ns)


class AcceleratedRobot(Robot):
    """A `Robot` whose steps run in code of a user, until this code fails.

    Then the guard stops the robot, and Python runs all steps until the robot is on the ground.
    """

    def __init__(
        self,
        simulator: Simulator,
        onboard: Onboard,
        guard: Guard,
        name: str,
        make: Callable[..., Any],
    ) -> None:
        """Make the other code, a `Robot`, with `make`; `name` is that of the user's file."""
        super().__init__(simulator, onboard, guard, name)
        self._faster: Robot = make(simulator, onboard, guard)
        self._faster.observers = self.observers
        self._has_failed = False

    def put_on_ground(self, now_ns: int, cause: str) -> None:
        """Reset the robot to its spawn, stopped, and record the reason `cause`."""
        self._has_failed = False
        try:
            self._faster.put_on_ground(now_ns, cause)
        except FAILURES as error:
            self._fail(error, now_ns)

    def run(self, tick_ns: int, until_ns: int) -> int:
        """Run steps from `tick_ns` up to `until_ns`; return the time of the next step [ns]."""
        if self._has_failed:
            return super().run(tick_ns, until_ns)
        try:
            ended_ns = self._faster.run(tick_ns, until_ns)
            RESULT.array(self.simulator.data.qvel, "velocity")
        except FAILURES as error:
            self._has_failed = True
            self._fail(error, tick_ns)
            return super().run(tick_ns, until_ns)
        self.failure, self._faster.failure = self._faster.failure or self.failure, None
        return ended_ns
