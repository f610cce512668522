"""Model what guard, onboard controller and cloud do not know: the true robot, and the wind."""

from __future__ import annotations

from math import exp, sqrt
from typing import Any

import numpy as np

from cloudrc.config.schema import Plant
from cloudrc.world.readings import Readings
from cloudrc.world.scene import mujoco


def apply_plant(plant: Plant, model: Any) -> None:
    """Change a compiled `MjModel`, whose only moving body is the robot's base.

    The payload adds m (d · d 1 - d d') to the inertia about the common centre of mass, with
    m = m1 m2/(m1 + m2) and the vector d between both centres.
    """
    if plant == Plant():
        return  # the model stays equal bit by bit
    base, payload = model.jnt_bodyid[0], plant.payload_kg
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, model.body_iquat[base])
    axes = turn.reshape(3, 3)
    mass = model.body_mass[base] * plant.mass_factor
    inertia = axes @ np.diag(model.body_inertia[base] * plant.inertia_factor) @ axes.T
    apart = np.subtract(plant.payload_offset_m, model.body_ipos[base])
    shared = mass * payload / (mass + payload)
    inertia += shared * (apart @ apart * np.eye(3) - np.outer(apart, apart))
    model.body_inertia[base], axes = np.linalg.eigh(inertia)
    axes[:, 0] *= np.linalg.det(axes)  # a rotation, not a mirror image
    mujoco.mju_mat2Quat(model.body_iquat[base], axes.ravel())
    model.body_mass[base] = mass + payload
    model.body_ipos[base] += apart * payload / (mass + payload)
    model.actuator_gainprm[:, 0] *= plant.thrust_factor
    mujoco.mj_setConst(model, mujoco.MjData(model))


class Wind:
    """Horizontal wind: a mean velocity, and gusts that are a first-order Gauss-Markov process.

    Source: D. J. Moorhouse, R. J. Woodcock, "Background Information and User Guide for
    MIL-F-8785C", 1982: the process has the longitudinal Dryden spectrum.
    Deviation: both axes have this spectrum, with a given time constant.
    """

    def __init__(
        self, mean: tuple[float, float], gust: float, time: float, rng: np.random.Generator
    ) -> None:
        """Set the mean [m/s], the deviation `gust` [m/s], and its time constant `time` [s]."""
        self._mean, self._gust, self._time, self._rng = mean, gust, time, rng
        self._gusts = gust * rng.standard_normal(2)

    def seen_from(self, readings: Readings, dt: float) -> Readings:
        """Return readings with the velocity relative to the air; advance the gusts by `dt` [s].

        w(t + dt) = a w(t) + s sqrt(1 - a^2) n, with a = exp(-dt/T), white noise n and deviation s.
        """
        (x, y), (vx, vy, vz) = (self._mean + self._gusts).tolist(), readings.velocity
        if self._gust:
            keep = exp(-dt / self._time)
            noise = self._gust * sqrt(1.0 - keep * keep) * self._rng.standard_normal(2)
            self._gusts = keep * self._gusts + noise
        return readings._replace(velocity=(vx - x, vy - y, vz))
