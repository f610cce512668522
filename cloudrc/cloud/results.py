# SPDX-License-Identifier: Apache-2.0

"""Judge the values that users' plug-ins return, so that only valid ones reach the robot.

Each function returns the value with plain floats, or raises an `InvalidValueError`, which counts as
a failure of the plug-in. The results of cloudrc's own plug-ins need no judge.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt
from typing import TYPE_CHECKING, Any

from cloudrc.base.outside.values import RESULT, WHOLE, InvalidValueError, shorten
from cloudrc.cloud.controllers import ControlOutput
from cloudrc.wire.messages import Odometry, Vector

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

SQUARE_TOLERANCE = 0.01
"""Largest deviation from 1 of an orientation's squared length [1]. A smaller one, such as that of a
first-order integration, is scaled away. ROS's tf2 accepts the same deviation."""
SQUARE_ROUNDING = 1e-9
"""Deviation from 1 of an orientation's squared length that comes from rounding [1]."""
OURS = (
    "cloudrc.cloud.estimators.",
    "cloudrc.cloud.predictors.",
    "cloudrc.cloud.controllers.pid",
    "cloudrc.cloud.planar",
)
"""Beginnings of the modules whose plug-ins return what they should."""


def is_ours(plug_in: Any) -> bool:
    """Return whether the results of a plug-in need no judge, because cloudrc ships it.

    What hands on the results of a user's file, such as a predictor with his model, says that it
    `is_foreign`.
    """
    is_foreign = getattr(plug_in, "is_foreign", False)
    return type(plug_in).__module__.startswith(OURS) and not is_foreign


def check_estimate(estimate: Any) -> Odometry:
    """Judge the odometry that a predictor or its model returned."""
    stamp_ns, position, orientation, velocity, rate = _parts(estimate)
    w, x, y, z = RESULT.row(orientation, 4, "orientation")
    square = w * w + x * x + y * y + z * z
    if not abs(square - 1.0) <= SQUARE_TOLERANCE:
        shown = f"({w:.4g}, {x:.4g}, {y:.4g}, {z:.4g})"
        raise InvalidValueError(f"its orientation {shown} has the length {sqrt(square):.4g}, not 1")
    if abs(square - 1.0) > SQUARE_ROUNDING:
        length = sqrt(square)
        w, x, y, z = w / length, x / length, y / length, z / length
    return Odometry(
        WHOLE.of(stamp_ns, "stamp"),
        to_vector(position, "position"),
        (w, x, y, z),
        to_vector(velocity, "velocity"),
        to_vector(rate, "angular velocity"),
    )


def check_output(output: Any) -> ControlOutput:
    """Judge the output of a controller."""
    velocity, yaw_rate, *terms = _parts(output)
    return ControlOutput(
        to_vector(velocity, "velocity"),
        RESULT.of(yaw_rate, "yaw rate"),
        *(to_vector(term, "PID term") for term in terms),
    )


def to_vector(numbers: Any, name: str) -> Vector:
    """Return three numbers as a tuple of floats; `name` names the value in the error's text."""
    x, y, z = RESULT.row(numbers, 3, name)
    return x, y, z


def to_rows(rows: Any, name: str) -> NDArray[np.float64]:
    """Return rows of three numbers as an array; `name` names them in the error's text."""
    found = RESULT.array(rows, name)
    if found.shape != (len(rows), 3):
        raise InvalidValueError(f"its {name} have the shape {found.shape}, not (n, 3)")
    return found.astype(float)


def to_vectors(rows: Any, name: str) -> list[Vector]:
    """Return rows of three numbers as tuples of floats; `name` names them in the error's text."""
    return [*zip(*to_rows(rows, name).T.tolist(), strict=True)]


def _parts(result: Any) -> Sequence[Any]:
    """Return the five parts of a result, in order."""
    if not isinstance(result, tuple | list) or len(result) != 5:
        raise InvalidValueError(f"its result is {shorten(result)}, not 5 values")
    return result
