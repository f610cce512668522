"""A robot whose usual steps run in the code of a user, which may fail in flight."""

from __future__ import annotations

from collections.abc import Callable
from math import isfinite
from typing import Any

from cloudrc.outside.code import FAILURES
from cloudrc.outside.values import shorten
from cloudrc.sim.onboard import Onboard
from cloudrc.sim.simulator import Simulator
from cloudrc.world.guard.state import Guard
from cloudrc.world.robot import STEP_NS, Robot
from cloudrc.world.watched import OnboardFailedError, WatchedOnboard, failure_of, where

STEPS = "the accelerator of the onboard controller"
"""The watched code in messages."""


class AcceleratedRobot(Robot):
    """A `Robot` that lets other code run the steps as long as this code does not fail.

    An exception, a wrong time of the next step, and values that are not finite are failures. Then
    the guard stops the robot, and Python runs all steps until the robot is on the ground again.
    """

    def __init__(
        self,
        simulator: Simulator,
        onboard: Onboard,
        guard: Guard,
        make: Callable[[Simulator, Onboard, Guard], Any],
    ) -> None:
        """Make the other code by `make`; it has the methods of `Robot`."""
        super().__init__(simulator, WatchedOnboard(onboard), guard)
        self._faster = make(simulator, onboard, guard)
        for method in ("run", "put_on_ground"):
            if not callable(getattr(self._faster, method, None)):
                raise ValueError(f"make returned {shorten(self._faster)}, without {method}()")
        self._faster.observers = self.observers
        self._has_failed = False
        data = simulator.data
        self._state: list[memoryview[float]] = [memoryview(data.qpos), memoryview(data.qvel)]

    def put_on_ground(self, now_ns: int, cause: str) -> None:
        """Reset the robot to its spawn, stopped, and record the reason `cause`."""
        self._has_failed = False
        try:
            self._faster.put_on_ground(now_ns, cause)
        except FAILURES as error:
            super().put_on_ground(now_ns, cause)
            self._stop(self._faster.put_on_ground, error, now_ns)

    def run(self, tick_ns: int, until_ns: int) -> int:
        """Run steps from `tick_ns` up to `until_ns`; return the time of the next step [ns]."""
        if self._has_failed:
            return super().run(tick_ns, until_ns)
        before = self.simulator.bad_values()
        try:
            ended_ns = self._faster.run(tick_ns, until_ns)
            self._check(ended_ns, until_ns, before)
        except FAILURES as error:
            self._stop(self._faster.run, error, tick_ns)
            return super().run(tick_ns, until_ns)
        # Its Python part has told of a failure of its own.
        self.failure = getattr(self._faster, "failure", None) or self.failure
        self._faster.failure = None
        return int(ended_ns)

    def _check(self, ended_ns: Any, until_ns: int, before: int) -> None:
        """Raise an OnboardFailedError if the state or the time of the next step is wrong."""
        wrong = ""
        if self.simulator.bad_values() != before or not isfinite(sum(map(sum, self._state))):
            wrong = "its values are not finite"
        elif not isinstance(ended_ns, int) or not 0 <= ended_ns - until_ns < STEP_NS:
            wrong = f"run() returned {shorten(ended_ns)}, not the time of the next step"
        if wrong:
            raise OnboardFailedError(f"{STEPS} failed ({wrong}, {where(self._faster.run)})")

    def _stop(self, call: Callable[..., Any], error: BaseException, now_ns: int) -> None:
        """Let the guard stop the robot because `call` raised `error`."""
        self._has_failed = True
        if not isinstance(error, OnboardFailedError):
            error = failure_of(STEPS, call, error)
        self._fail(error, now_ns)
