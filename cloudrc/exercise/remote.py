"""Plug-ins of the check whose results come from the process of a hand-in."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import count
from typing import Any

from cloudrc.cloud.controllers import Controller, ControlOutput
from cloudrc.cloud.estimators import DelaySample, Estimator
from cloudrc.cloud.predictors import Predictor
from cloudrc.errors import to_one_line
from cloudrc.exercise.hand_in import Call
from cloudrc.messages import Command, Odometry, Setpoint
from cloudrc.outside.values import InvalidValueError


class HandInError(InvalidValueError):
    """A student's file failed; the text says where and why."""


class Remote:
    """Calls the functions of a hand-in; several calls without a result share one request."""

    def __init__(self, ask: Callable[[Sequence[Call]], tuple[Any, str]]) -> None:
        """Set the function that sends calls, and returns a result and an error, or ""."""
        self._ask = ask
        self._waiting: list[Call] = []
        self._numbers = count(1)

    def build(self, part: str, **parameters: Any) -> Any:
        """Build the student's plug-in for a part, such as "predictor"."""
        name = f"{part} {next(self._numbers)}"
        self.call(name, "build", parameters)
        return _PLUGINS[part](self, name)

    def post(self, name: str, method: str, *arguments: Any) -> None:
        """Call a method without a result before the next one that has a result."""
        self._waiting.append((name, method, arguments))

    def call(self, name: str, method: str, arguments: Any) -> Any:
        """Call a method, after all that wait; return its result.

        Raises:
            HandInError: If one of the calls failed.
        """
        calls, self._waiting = [*self._waiting, (name, method, arguments)], []
        result, error = self._ask(calls)
        if error:
            raise HandInError(to_one_line(error))
        return result


class _Part:
    def __init__(self, remote: Remote, name: str) -> None:
        self._remote, self._name = remote, name

    def reset(self) -> None:
        """Forget the past."""
        self._remote.post(self._name, "reset")


class RemoteEstimator(_Part, Estimator):
    """A student's delay estimator."""

    def update(self, sample: DelaySample) -> None:
        """Add the delays that one telemetry datagram shows."""
        self._remote.post(self._name, "update", sample)

    def add_applied(self, applied_minus_stamp: float) -> None:
        """Add a command that world has applied, with its `applied_minus_stamp` [s]."""
        self._remote.post(self._name, "add_applied", applied_minus_stamp)

    def horizon(self, age: float) -> float:
        """Return the horizon [s]; `age` is that of the newest odometry [s]."""
        horizon: float = self._remote.call(self._name, "horizon", [age])
        return horizon


class RemotePredictor(_Part, Predictor):
    """A student's predictor."""

    def observe(self, odometry: Odometry) -> None:
        """Process a new odometry sample."""
        self._remote.post(self._name, "observe", odometry)

    def commanded(self, command: Command) -> None:
        """Process a command that cloud has just sent."""
        self._remote.post(self._name, "commanded", command)

    def applied(self, command_stamp_ns: int, applied_ns: int) -> None:
        """Store when world applied a command."""
        self._remote.post(self._name, "applied", command_stamp_ns, applied_ns)

    def predict(self, odometry: Odometry, horizon: float) -> Odometry:
        """Extrapolate the newest sample by `horizon` [s]."""
        answer = self._remote.call(self._name, "predict", [odometry, horizon])
        return Odometry(*_parts(answer, Odometry))


class RemoteController(_Part, Controller):
    """A student's controller."""

    def update(self, estimate: Odometry, setpoint: Setpoint, dt: float) -> ControlOutput:
        """Compute one command; `dt` is the time since the last call [s]."""
        answer = self._remote.call(self._name, "update", [estimate, setpoint, dt])
        return ControlOutput(*_parts(answer, ControlOutput))


_PLUGINS: dict[str, Callable[[Remote, str], Any]] = {
    "estimator": RemoteEstimator,
    "predictor": RemotePredictor,
    "controller": RemoteController,
}


def _parts(answer: Any, kind: Any) -> list[Any]:
    """Return the parts of a named tuple in an answer; the control loop checks their numbers."""
    if not isinstance(answer, list) or len(answer) != len(kind._fields):
        raise InvalidValueError(f"its result is no {kind.__name__}")
    return [tuple(each) if isinstance(each, list) else each for each in answer]
