"""Check the values that plug-ins return, so that only valid ones reach commands and recordings.

A plug-in of a user may return anything. Each function here returns the value with plain floats, or
raises an `InvalidResultError`, which counts as a failure of the plug-in. The results of cloudrc's
own plug-ins need no judge.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Set
from itertools import islice
from math import hypot, isfinite, sqrt
from typing import Any, NoReturn

from cloudrc.cloud.controllers import ControlOutput
from cloudrc.messages import Odometry, Quaternion, Vector
from cloudrc.plugins import LARGEST, InvalidResultError, shorten, to_integer, to_number

SQUARE_TOLERANCE = 0.01
"""Largest deviation from 1 of an orientation's squared length [1]. A smaller one, such as that of a
first-order integration, is scaled away. ROS's tf2 accepts the same deviation."""
SQUARE_ROUNDING = 1e-9
"""Deviation from 1 of an orientation's squared length that comes from rounding [1]."""
OURS = "cloudrc.cloud.estimators.", "cloudrc.cloud.predictors.", "cloudrc.cloud.controllers.pid"
"""Beginnings of the modules whose plug-ins return what they should."""
FOREIGN = ("cloudrc.cloud.predictors.model_based",)
"""Modules among them whose plug-ins return what the files of a robot compute."""
_new = tuple.__new__  # makes a named tuple twice as fast as its class does


def is_ours(plug_in: Any) -> bool:
    """Return whether the results of a plug-in need no check, because cloudrc ships it."""
    module = type(plug_in).__module__
    return module.startswith(OURS) and module not in FOREIGN


def check_estimate(estimate: Any) -> Odometry:
    """Check the odometry that a predictor or its model returned; return it with plain numbers."""
    stamp_ns, position, orientation, velocity, rate = _unpack(estimate, 5, "result")
    position, velocity = to_vector(position, "position"), to_vector(velocity, "velocity")
    rate = to_vector(rate, "angular velocity")
    w, x, y, z = _unpack(orientation, 4, "orientation")
    if not float is type(w) is type(x) is type(y) is type(z):
        w, x, y, z = (to_number(each, "orientation") for each in (w, x, y, z))
    square = w * w + x * x + y * y + z * z
    if not is_fit(*position, *velocity, *rate) or not abs(square - 1.0) <= SQUARE_TOLERANCE:
        _refuse_estimate(position, velocity, rate, (w, x, y, z))
    if abs(square - 1.0) > SQUARE_ROUNDING:
        length = sqrt(square)
        w, x, y, z = w / length, x / length, y / length, z / length
    if not (type(stamp_ns) is int and -LARGEST <= stamp_ns <= LARGEST):  # the usual case is fast
        stamp_ns = to_integer(stamp_ns, "stamp")
        refuse("stamp", stamp_ns)
    return _new(Odometry, (stamp_ns, position, (w, x, y, z), velocity, rate))


def check_output(output: Any) -> ControlOutput:
    """Check the output of a controller; return it with plain numbers."""
    velocity, yaw_rate, *given = _unpack(output, 5, "result")
    velocity, yaw_rate = to_vector(velocity, "velocity"), to_number(yaw_rate, "yaw rate")
    proportional, integral, derivative = (to_vector(each, "PID term") for each in given)
    if not is_fit(*velocity, yaw_rate, *proportional, *integral, *derivative):
        refuse("velocity", *velocity)
        refuse("yaw rate", yaw_rate)
        refuse("PID terms", *proportional, *integral, *derivative)
        refuse("result", *velocity, yaw_rate, *proportional, *integral, *derivative)
    return _new(ControlOutput, (velocity, yaw_rate, proportional, integral, derivative))


def to_vector(numbers: Any, name: str) -> Vector:
    """Return three numbers as a tuple of floats; `name` names the value in the error's text."""
    if type(numbers) is tuple and len(numbers) == 3:  # the usual case, which must be fast
        x, y, z = numbers
        if float is type(x) is type(y) is type(z):
            return numbers
    x, y, z = _unpack(numbers, 3, name)
    return to_number(x, name), to_number(y, name), to_number(z, name)


def is_fit(*numbers: float) -> bool:
    """Return whether all numbers are finite, and none is beyond `LARGEST`."""
    return hypot(*numbers) <= LARGEST  # False for NaN


def refuse(name: str, *numbers: float) -> None:
    """Raise an InvalidResultError if the numbers are not finite or too large."""
    if not is_fit(*numbers):
        beyond = f", beyond {LARGEST:g}" if all(map(isfinite, numbers)) else ""
        shown = ", ".join(f"{each:.4g}" for each in numbers)
        raise InvalidResultError(f"its {name} is ({shown}){beyond}")


def _refuse_estimate(
    position: Vector, velocity: Vector, rate: Vector, orientation: Quaternion
) -> NoReturn:
    refuse("position", *position)
    refuse("velocity", *velocity)
    refuse("angular velocity", *rate)
    refuse("orientation", *orientation)
    refuse("result", *position, *velocity, *rate)
    shown = ", ".join(f"{each:.4g}" for each in orientation)
    length = sqrt(sum(each * each for each in orientation))
    raise InvalidResultError(f"its orientation ({shown}) has the length {length:.4g}, not 1")


def _unpack(value: Any, count: int, name: str) -> tuple[Any, ...]:
    """Return the `count` parts of a value, in order."""
    if isinstance(value, tuple) and len(value) == count:
        return value
    parts: tuple[Any, ...] = ()
    is_row = isinstance(value, Iterable) and getattr(value, "shape", None) != ()
    if is_row and not isinstance(value, str | bytes | Set | Mapping):
        parts = tuple(islice(value, count + 1))  # it may be endless
    if len(parts) != count:
        raise InvalidResultError(f"its {name} is {shorten(value)}, not {count} values")
    return parts
