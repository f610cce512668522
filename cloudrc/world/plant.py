"""Model what guard, onboard controller and cloud do not know: the true robot, and the wind."""

from __future__ import annotations

from dataclasses import dataclass
from math import exp, sqrt
from typing import Any

import numpy as np

from cloudrc.messages import ZERO, Vector
from cloudrc.world.readings import Readings
from cloudrc.world.scene import mujoco


@dataclass(frozen=True, slots=True)
class Plant:
    """How the true robot differs from its model.

    Attributes:
        mass_factor: True mass, as a multiple of the model's [1].
        inertia_factor: True inertia about each axis, as a multiple of the model's [1].
        payload: Mass of a point that is fixed to the robot [kg].
        payload_offset: Position of this point [m], body frame, shape (3,).
        thrust_factors: True thrust and torque of each rotor, as a multiple of the model's [1],
            shape (4,).
    """

    mass_factor: float = 1.0
    inertia_factor: float = 1.0
    payload: float = 0.0
    payload_offset: Vector = ZERO
    thrust_factors: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)

    def apply(self, model: Any) -> None:
        """Change a compiled `MjModel`, whose only moving body is the robot's base.

        The payload adds to the inertia about the common centre of mass, with m = m1 m2/(m1 + m2)
        and the distance d between both centres: m (d · d 1 - d d').
        """
        if self == Plant(payload_offset=self.payload_offset):
            return  # the model stays equal bit by bit
        base = model.jnt_bodyid[0]
        turn = np.empty(9)
        mujoco.mju_quat2Mat(turn, model.body_iquat[base])
        axes = turn.reshape(3, 3)
        mass = model.body_mass[base] * self.mass_factor
        inertia = axes @ np.diag(model.body_inertia[base] * self.inertia_factor) @ axes.T
        total = mass + self.payload
        apart = np.subtract(self.payload_offset, model.body_ipos[base])
        shared = mass * self.payload / total
        inertia += shared * (apart @ apart * np.eye(3) - np.outer(apart, apart))
        moments, axes = np.linalg.eigh(inertia)
        axes *= np.sign(np.linalg.det(axes))  # a rotation, not a mirror image
        mujoco.mju_mat2Quat(model.body_iquat[base], axes.ravel())
        model.body_inertia[base] = moments
        model.body_mass[base] = total
        model.body_ipos[base] += apart * (self.payload / total)
        model.actuator_gainprm[:, 0] *= self.thrust_factors
        mujoco.mj_setConst(model, mujoco.MjData(model))


class Wind:
    """Horizontal wind: a mean velocity, and gusts that are a first-order Gauss-Markov process.

    Source: D. J. Moorhouse, R. J. Woodcock, "Background Information and User Guide for
    MIL-F-8785C", 1982: the longitudinal Dryden spectrum is that of this process.
    Deviation: both axes have this spectrum; the time constant is given, and does not follow from
    height and airspeed.
    """

    def __init__(
        self, mean: tuple[float, float], gust: float, time: float, rng: np.random.Generator
    ) -> None:
        """Set mean velocity [m/s], deviation of the gusts [m/s] and their time constant [s]."""
        self._mean, self._gust, self._time, self._rng = mean, gust, time, rng
        self._gusts = gust * rng.standard_normal(2)

    def advance(self, dt: float) -> tuple[float, float]:
        """Advance the gusts by `dt` [s]; return the air's velocity in x and y [m/s], world frame.

        w(t + dt) = a w(t) + s sqrt(1 - a^2) n, with a = exp(-dt/T), white noise n and deviation s.
        """
        if self._gust:
            keep = exp(-dt / self._time)
            noise = self._gust * sqrt(1.0 - keep * keep) * self._rng.standard_normal(2)
            self._gusts = keep * self._gusts + noise
        x, y = self._gusts.tolist()
        return self._mean[0] + x, self._mean[1] + y

    def seen_from(self, readings: Readings, dt: float) -> Readings:
        """Advance the gusts by `dt` [s]; return readings with the velocity relative to the air."""
        (x, y), (vx, vy, vz) = self.advance(dt), readings.velocity
        return readings._replace(velocity=(vx - x, vy - y, vz))
