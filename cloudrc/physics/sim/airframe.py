# SPDX-License-Identifier: Apache-2.0

"""Read what a flight controller needs to know of a robot from its compiled MuJoCo model.

Mass, centre of mass, inertia, gravity, and what each actuator does come from the model alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from cloudrc.physics.sim.engine import TRANSMISSION, at_rest, mujoco
from cloudrc.physics.sim.plant import Array, Inertia

_DYN = mujoco.mjtDyn
DYNAMICS = list(map(int, (_DYN.mjDYN_NONE, _DYN.mjDYN_FILTER, _DYN.mjDYN_FILTEREXACT)))
"""Accepted activation dynamics (dyntype) of an actuator: none, or a first-order lag."""
INDEPENDENT = 1e-3
"""Smallest part of a force or torque that must be independent of the others, relative to it [1]."""
HINTS = {
    "torque about x (roll)": "place the actuators on both sides of the centre of mass",
    "torque about y (pitch)": "place the actuators before and behind the centre of mass",
    "force along z (thrust)": "let the actuators push along the base's z axis",
    "torque about z (yaw)": "neighbours need opposite spin directions, the signs of "
    "the last number of gear; or leave the yaw alone with yaw_bandwidth_radps: 0",
}
"""Forces and torques that a controller commands, in the order of the rows of `Airframe.wrench` ->
what to do if the actuators cannot make it independently of those before it."""


@dataclass(frozen=True)
class Airframe:
    """A rigid body that actuators push at sites. Vectors are in the frame of the base."""

    names: list[str]  # of the n actuators
    mass: float  # [kg]
    centre: Array  # centre of mass [m], shape (3,)
    inertia: Array  # about the centre of mass [kg m^2], shape (3, 3)
    gravity: float  # acceleration that hover must balance [m/s^2]
    # Torques about x and y, force along z, torque about z, per unit of each control; the torques
    # are about the centre of mass. Without the last row, the controller leaves the yaw alone.
    wrench: Array  # [N] and [N m] per unit, shape (4, n) or (3, n)
    low: Array  # smallest value of each control, in its own unit [any unit], shape (n,)
    high: Array  # largest value of each control, in its own unit [any unit], shape (n,)
    lag: float  # largest time constant of an actuator [s]; 0: none


def read_airframe(model: Any, *, steers_yaw: bool = True) -> Airframe:
    """Read a compiled `MjModel`; raise a ValueError if it is no rigid body with thrusters.

    Without `steers_yaw`, it need not turn about z.
    """
    if model.njnt > 1:
        raise ValueError(
            f"{_name(model.joint(1), 1)} is a second joint; multirotor flies one rigid body, so "
            "nothing else may move: delete the joint"
        )
    names = [_name(model.actuator(number), number) for number in range(model.nu)]
    for number, name in enumerate(names):
        _check_actuator(model, number, name)
    low, high = np.array([_limits(model, number) for number in range(model.nu)]).T

    data = at_rest(model)
    mass, centre, inertia = _inertia(model, data)
    weight = data.qfrc_bias - data.qfrc_passive
    if weight[2] <= 0.0:
        raise ValueError("gravity does not point down (-z) in this scene; multirotor needs it")
    lags = model.actuator_dynprm[:, 0][model.actuator_dyntype != _DYN.mjDYN_NONE]
    frame = Airframe(
        names=names,
        mass=mass,
        centre=centre,
        inertia=inertia,
        gravity=float(weight[2]) / mass,
        wrench=_wrench(model, data, centre)[: 4 if steers_yaw else 3],
        low=low,
        high=high,
        lag=float(max(lags, default=0.0)),
    )
    _check_directions(frame)
    return frame


def thrust_to_weight(model: Any) -> float | None:
    """Return the largest force along the base's z axis, relative to the weight [1].

    The model is a compiled `MjModel`. Return None for a robot that no actuator at a site lifts,
    because its forces are not in the model.
    """
    data = at_rest(model)
    at_site = model.actuator_trntype == TRANSMISSION.mjTRN_SITE
    lift = np.where(at_site, _pushes(model, data)[0][:, 2], 0.0)
    weight = -model.body_subtreemass[model.jnt_bodyid[0]] * model.opt.gravity[2]
    if not lift.any() or weight <= 0.0:
        return None
    limits = np.array([_limits(model, number) for number in np.flatnonzero(lift).tolist()])
    most = (lift[lift != 0.0, None] * limits).max(axis=1).sum()
    return float(most / weight)


def read_turns(model: Any) -> dict[str, str]:
    """Return which way each rotor turns, seen from the side that it pushes to: actuator -> word.

    A rotor turns against its torque on the robot. An actuator at no site, or without force or
    torque, is no rotor. The model is a compiled `MjModel`.
    """
    forces, torques = np.split(model.actuator_gear, 2, axis=1)
    along = (forces * torques).sum(axis=1) * (model.actuator_trntype == TRANSMISSION.mjTRN_SITE)
    turns = {}
    for number in np.flatnonzero(along).tolist():
        word = "clockwise" if along[number] > 0 else "counter-clockwise"
        turns[_name(model.actuator(number), number)] = word
    return turns


def _inertia(model: Any, data: Any) -> Inertia:
    """Read mass, centre of mass and inertia from the mass matrix of the free joint.

    The matrix counts all bodies that are fixed to the base. Its first three rows are forces in the
    world frame, its last three are torques in the body frame about the base's origin. With the
    base's orientation R, mass m, centre c and inertia J, its blocks are m I and -m R [c] above,
    J - m [c][c] below on the right; [c] is the matrix of the cross product with c.
    """
    matrix, column = np.empty((6, 6)), np.empty(6)
    for number, unit in enumerate(np.eye(6)):
        mujoco.mj_mulM(model, data, column, unit)
        matrix[:, number] = column
    mass = float(matrix[0, 0])
    cross = -_axes(model, data).T @ matrix[:3, 3:] / mass
    centre = np.array((cross[2, 1], cross[0, 2], cross[1, 0]))
    return mass, centre, matrix[3:, 3:] + mass * cross @ cross


def _wrench(model: Any, data: Any, centre: Array) -> Array:
    """Return what one unit of each control does, as `Airframe.wrench`."""
    forces, torques = _pushes(model, data)
    torques = torques - np.cross(centre, forces)
    return np.array((torques[:, 0], torques[:, 1], forces[:, 2], torques[:, 2]))


def _pushes(model: Any, data: Any) -> tuple[Array, Array]:
    """Return force and torque of one unit of each control, about the base's origin, shape (n, 3).

    They are in [N] and [N m], in the frame of the base.
    """
    moments = np.zeros((model.nu, model.nv))
    mujoco.mju_sparse2dense(
        moments,
        data.actuator_moment.ravel(),
        data.moment_rownnz,
        data.moment_rowadr,
        data.moment_colind.ravel(),
    )
    moments *= model.actuator_gainprm[:, :1]
    return moments[:, :3] @ _axes(model, data), moments[:, 3:6]


def _axes(model: Any, data: Any) -> Array:
    """Return the orientation of the base, body to world, shape (3, 3)."""
    axes: Array = data.xmat[model.jnt_bodyid[0]].reshape(3, 3)
    return axes


def read_thrusters(model: Any) -> tuple[Array, Array]:
    """Return place [m] and force per unit of control [N] of each actuator, shape (n, 3).

    Both are in the frame of the base.
    """
    data = at_rest(model)
    sites, base = model.actuator_trnid[:, 0], model.jnt_bodyid[0]
    places = (data.site_xpos[sites] - data.xpos[base]) @ _axes(model, data)
    return places, _pushes(model, data)[0]


def span(frame: Airframe) -> Array:
    """Return the width of each control's range [any unit], shape (n,); 1 if a range is infinite."""
    width: Array = frame.high - frame.low
    return width if np.isfinite(width).all() else np.ones_like(width)


def _check_actuator(model: Any, number: int, name: str) -> None:
    """Raise an error if an actuator does not push at a site by gain times control."""
    site, reference = model.actuator_trnid[number]
    pushes = (
        model.actuator_trntype[number] == TRANSMISSION.mjTRN_SITE
        and reference < 0
        and model.body_rootid[model.site_bodyid[site]] == model.jnt_bodyid[0]
        and model.actuator_gaintype[number] == mujoco.mjtGain.mjGAIN_FIXED
        and model.actuator_biastype[number] == mujoco.mjtBias.mjBIAS_NONE
        and model.actuator_gainprm[number, 0] != 0.0
        and model.actuator_dyntype[number] in DYNAMICS
    )
    if not pushes:
        raise ValueError(
            f"actuator {name} must push at a site of the robot by gain times control: use <motor>, "
            "or <general> with a fixed gain other than 0, without refsite and bias, and with "
            "dyntype none, filter or filterexact"
        )


def _limits(model: Any, number: int) -> tuple[float, float]:
    """Return the range of a control, in which its force stays within its own range, too."""
    low, high = -np.inf, np.inf
    if model.actuator_ctrllimited[number]:
        low, high = model.actuator_ctrlrange[number]
    gain = model.actuator_gainprm[number, 0]
    for limited, limits in (
        (model.actuator_forcelimited[number], model.actuator_forcerange[number] / gain),
        (model.actuator_actlimited[number], model.actuator_actrange[number]),
    ):
        if limited:
            low, high = max(low, min(limits)), min(high, max(limits))
    return float(low), float(high)


def _check_directions(frame: Airframe) -> None:
    """Raise an error if the actuators cannot make each force and torque by itself."""
    known = np.empty((0, len(frame.names)))
    rows = frame.wrench * span(frame)
    for (direction, hint), row in zip(HINTS.items(), rows, strict=False):
        size = np.linalg.norm(row)
        rest = row - row @ np.linalg.pinv(known) @ known
        if not size or np.linalg.norm(rest) <= INDEPENDENT * size:
            raise ValueError(f"the actuators cannot make a {direction} by itself: {hint}")
        known = np.vstack((known, row / size))


def _name(part: Any, number: int) -> str:
    """Return the name of a joint or actuator in the robot's file, or its number."""
    return part.name.rpartition("/")[2] or f"number {number + 1}"
