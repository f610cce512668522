# SPDX-License-Identifier: Apache-2.0

"""Read the driven wheels of a robot from its compiled MuJoCo model."""

from __future__ import annotations

from math import hypot, inf
from typing import Any, NamedTuple

import numpy as np

from cloudrc.physics.sim.engine import GEOM, JOINT, TRANSMISSION, at_rest
from cloudrc.physics.sim.scene import ROBOT_PREFIX

LEVEL = 0.05
"""Largest sine of the angle between a wheel's axis and the base's y axis."""
ROUND = tuple(
    int(getattr(GEOM, f"mjGEOM_{shape}")) for shape in ("CYLINDER", "SPHERE", "ELLIPSOID")
)
"""Shapes whose first size is the radius of a wheel."""


class Wheel(NamedTuple):
    """A driven wheel."""

    y: float  # distance to the left of the base [m]
    command: float  # value of the actuator per speed of the wheel over the ground [rad/m]
    speed_max: float  # largest speed over the ground [m/s]


def read_wheels(model: Any, radius: float | None) -> list[Wheel]:
    """Read the wheels of a compiled `MjModel`, in which each actuator is the servo of a wheel.

    `radius` is that of the wheels [m]; None: that of the largest round geom of each wheel.

    Raises:
        ValueError: If the model has no such wheels.
    """
    data, base = at_rest(model), model.jnt_bodyid[0]
    frame = data.xmat[base].reshape(3, 3)
    wheels = []
    for number in range(model.nu):
        turns = model.actuator_trntype[number] == TRANSMISSION.mjTRN_JOINT
        joint = int(model.actuator_trnid[number, 0]) if turns else 0  # joint 0 is no hinge
        size = radius or _radius(model, joint)
        axis = data.xaxis[joint] @ frame
        if wrong := _what_is_wrong(model, number, joint, axis, size):
            name = model.actuator(number).name.removeprefix(ROBOT_PREFIX) or number
            raise ValueError(f"actuator '{name}': {wrong}")
        gear = float(model.actuator_gear[number, 0] * np.sign(axis[1]))
        most = model.actuator_ctrlrange[number] if model.actuator_ctrllimited[number] else [inf]
        speed_max = float(np.abs(most).min()) * size / abs(gear)
        place = (data.xanchor[joint] - data.xpos[base]) @ frame
        wheels.append(Wheel(float(place[1]), gear / size, speed_max))
    if not min(wheel.y for wheel in wheels) < 0.0 < max(wheel.y for wheel in wheels):
        raise ValueError("needs driven wheels on both sides: y above 0 and below 0")
    return wheels


def _what_is_wrong(model: Any, number: int, joint: int, axis: Any, radius: float) -> str:
    """Return why an actuator is no servo of a wheel with this joint, axis [1] and radius [m]."""
    gain, bias = model.actuator_gainprm[number, 0], model.actuator_biasprm[number]
    if model.jnt_type[joint] != JOINT.mjJNT_HINGE:
        return "it must turn the hinge of a wheel"
    if not gain > 0.0 or bias[2] != -gain or bias[:2].any() or not model.actuator_gear[number, 0]:
        return "it must be a velocity servo, in MJCF: <velocity kv=...>"
    if hypot(axis[0], axis[2]) > LEVEL:
        return "its axis must point along the base's y"
    return "" if radius else "its wheel has no round geom; set onboard.wheel_radius_m"


def _radius(model: Any, joint: int) -> float:
    """Return the radius of the largest round geom at a joint [m]; 0 without one."""
    geoms = np.flatnonzero(model.geom_bodyid == model.jnt_bodyid[joint])
    round_ = (model.geom_size[geom, 0] for geom in geoms if model.geom_type[geom] in ROUND)
    return float(max(round_, default=0.0))
