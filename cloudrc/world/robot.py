# SPDX-License-Identifier: Apache-2.0

"""The robot: in every step, guard and onboard controller turn readings into commands."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from cloudrc.base.errors import describe_error
from cloudrc.base.outside.code import FAILURES, check_failure, locate, stack_of
from cloudrc.base.outside.values import RESULT, InvalidValueError
from cloudrc.physics.sim.onboard import Commands, Onboard
from cloudrc.physics.sim.readings import Readings
from cloudrc.physics.sim.simulator import Simulator
from cloudrc.wire.messages import Command, GuardState, OperatorRequest, Vector
from cloudrc.wire.records import Fault
from cloudrc.world.guard.state import Guard

STEP_NS = 2_000_000
"""Duration of one step of physics, onboard controller and guard [ns].
Source: docs/reference/plant.md, "Physics step"."""
STEP = STEP_NS * 1e-9
"""Duration of one step [s]."""
TRACK, ESTOP = GuardState.TRACK, GuardState.ESTOP  # looking up a member of an enum is slow


class Observer(NamedTuple):
    """Functions that learn what a robot does; times are on world's clock [ns]."""

    see_step: Callable[[int, Readings, Commands], None]
    """Gets the time of a step, and readings and commands in it"""
    see_command: Callable[[Command, str | None, int], None]
    """Gets a command, why the guard has rejected it (None: it has not), and when it has come"""
    see_request: Callable[[OperatorRequest, int], None]
    """Gets a request that the robot has carried out, and when"""
    see_session: Callable[[int], None]
    """Gets the time at which a session has begun"""


class Robot:
    """Runs physics, guard and onboard controller step by step, and informs `observers`.

    Onboard controller and actuators may be code of a user. If it fails in flight, the guard stops
    the robot.

    Attributes:
        failure: Why the guard stopped the robot, until a caller sets None; None: no failure.
        name: Name of the user's file whose code steers or steps the robot, which is judged; "" if
            all code is cloudrc's.
    """

    def __init__(self, simulator: Simulator, onboard: Onboard, guard: Guard) -> None:
        self.simulator, self.onboard, self.guard = simulator, onboard, guard
        self.observers = list[Observer]()
        self.failure: Fault | None = None
        self.name, self._size = "", len(onboard.stopped)
        self._update, self._brake = onboard.update, onboard.brake

    def start_again(self, now_ns: int, cause: str) -> None:
        """Reset the robot as `put_on_ground` does; if a user's code fails, the guard stops it."""
        try:
            self.put_on_ground(now_ns, cause)
        except FAILURES as error:
            self._fail(error, now_ns)

    def put_on_ground(self, now_ns: int, cause: str) -> None:
        """Reset the robot to its spawn, stopped, and record the reason `cause`."""
        self.guard.put_on_ground(now_ns, cause)
        self.simulator.reset()
        self.onboard.reset()

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
        return RESULT.row(commands, self._size, "result") if self.name else commands

    def advance(self, tick_ns: int, until_ns: int) -> int:
        """Run steps of a robot with a user's code as `run` does; if it fails, Python runs them.

        Then the guard has stopped the robot.
        """
        try:
            ended_ns = self.run(tick_ns, until_ns)
            RESULT.array(self.simulator.data.qvel, "velocity")
        except FAILURES as error:
            self._fail(error, tick_ns)
            return Robot.run(self, tick_ns, until_ns)
        return ended_ns

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
            place = self.name if isinstance(error, InvalidValueError) else locate(error)
            what = f"the onboard controller failed ({describe_error(error)}, {place})"
            text = f"{what}; the guard stopped the robot; fix the file"
            self.failure = Fault(now_ns, "onboard_failed", text, stack_of(error))
        self.guard.fail(now_ns)
