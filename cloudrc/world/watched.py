"""Watch the code that a robot brings: its onboard controller, and the physics of its actuators.

Both may be files of the user, which may raise anything and return anything. Their failure in flight
is an `OnboardFailedError`, on which the guard stops the robot.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import CodeType
from typing import Any

from cloudrc.errors import describe_error
from cloudrc.messages import NEVER_NS, Vector
from cloudrc.outside.code import FAILURES, check_failure, locate, stack_of
from cloudrc.outside.values import RESULT, InvalidValueError
from cloudrc.sim.onboard import Actuators, Commands, Inputs, Onboard
from cloudrc.sim.readings import Readings

WHAT, PHYSICS = "the onboard controller", "the actuators of the onboard controller"
"""The watched objects in messages."""


class OnboardFailedError(Exception):
    """An onboard controller or its actuators failed.

    Attributes:
        trace: Stack of the failure, or "" if a value is wrong.
        stamp_ns: Time of the step in which the guard stopped the robot [ns], world's clock.
    """

    def __init__(self, text: str, trace: str = "") -> None:
        """Set the text, one line that names file and line, and the stack."""
        super().__init__(text)
        self.trace, self.stamp_ns = trace, NEVER_NS


class WatchedOnboard:
    """An onboard controller whose calls raise an `OnboardFailedError` if they fail.

    Attributes:
        stopped: Commands while the guard has stopped the robot.
    """

    def __init__(self, onboard: Onboard) -> None:
        """Watch `onboard`, whose `stopped` are finite numbers."""
        self.stopped: Commands = tuple([float(value) for value in onboard.stopped])
        self._size = len(self.stopped)
        self._reset, self._update, self._brake = onboard.reset, onboard.update, onboard.brake

    def reset(self) -> None:
        """Forget everything; the robot is stopped."""
        _call(WHAT, self._reset)

    def update(self, readings: Readings, velocity: Vector, yaw_rate: float) -> Commands:
        """Return the commands that make the robot follow a velocity [m/s] and yaw rate [rad/s]."""
        commands = _call(WHAT, self._update, readings, velocity, yaw_rate)
        return _floats(commands, self._size, WHAT, self._update)

    def brake(self, readings: Readings, velocity: Vector) -> Commands:
        """Return commands as `update` does, while the guard brakes to a velocity [m/s]."""
        commands = _call(WHAT, self._brake, readings, velocity)
        return _floats(commands, self._size, WHAT, self._brake)


class WatchedActuators:
    """Actuators that raise an `OnboardFailedError` when they fail, and from then on push nothing.

    Attributes:
        speeds: What the actuators do at present.
    """

    def __init__(self, actuators: Actuators, inputs: int) -> None:
        """Watch `actuators` of a model with `inputs` controls."""
        self._actuators = actuators
        self._size = inputs + 6
        self._rest: Inputs = (0.0,) * self._size
        self._has_failed = False

    @property
    def speeds(self) -> Commands:
        """What the actuators do at present."""
        return self._actuators.speeds

    @speeds.setter
    def speeds(self, speeds: Commands) -> None:
        self._actuators.speeds = speeds

    def reset(self) -> None:
        """Stand still."""
        self._has_failed = True  # as long as the reset does not succeed
        _call(PHYSICS, self._actuators.reset)
        self._has_failed = False

    def step(self, commands: Commands, readings: Readings) -> Inputs:
        """Advance by one physics step towards `commands`; return the input to MuJoCo."""
        if self._has_failed:
            return self._rest
        self._has_failed = True  # as long as the step does not succeed
        step = self._actuators.step
        inputs = _floats(_call(PHYSICS, step, commands, readings), self._size, PHYSICS, step)
        self._has_failed = False
        return inputs


def _call(what: str, function: Callable[..., Any], *given: Any) -> Any:
    """Call a function of the user; its failure is an OnboardFailedError."""
    try:
        return function(*given)
    except FAILURES as error:
        raise failure_of(what, function, error) from error


def _floats(values: Any, size: int, what: str, call: Callable[..., Any]) -> tuple[float, ...]:
    """Return the values of a `call` as floats; refuse another number of values, and wrong ones."""
    try:
        return RESULT.row(values, size, "result")
    except InvalidValueError as error:
        raise OnboardFailedError(f"{what} failed ({error}, {where(call)})") from None


def failure_of(what: str, call: Callable[..., Any], error: BaseException) -> OnboardFailedError:
    """Return what to raise for an exception that `call` raised.

    Raises:
        BaseException: `error`, if it is not the failure of the user's code.
    """
    check_failure(error, what)
    is_inside = error.__traceback__ is not None and error.__traceback__.tb_next is not None
    place = locate(error) if is_inside else where(call)  # a call with wrong arguments
    return OnboardFailedError(f"{what} failed ({describe_error(error)}, {place})", stack_of(error))


def where(call: Callable[..., Any]) -> str:
    """Return file and line of a function of the user."""
    code = getattr(call, "__code__", None)
    if not isinstance(code, CodeType):
        return f"in {type(call).__name__}"
    return f"{Path(code.co_filename).name}:{code.co_firstlineno} in {code.co_name}"
