# SPDX-License-Identifier: Apache-2.0

"""Model the true robot and the wind, which guard, onboard controller and cloud do not know."""

from __future__ import annotations

from math import exp, sqrt
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cloudrc.physics.sim.readings import Readings

if TYPE_CHECKING:
    from cloudrc.config import disturbances

Array: TypeAlias = NDArray[np.float64]


Inertia: TypeAlias = tuple[float, Array, Array]
"""Mass [kg], centre of mass [m], shape (3,), and inertia about this centre [kg m^2], shape (3, 3),
of a robot in its body frame."""


def point_inertia(mass: float, place: Array) -> Array:
    """Return the inertia m (|d|^2 I - d d') of a point mass [kg m^2], shape (3, 3).

    `mass` is m [kg]; `place` is d [m], shape (3,).
    """
    return mass * (place @ place * np.eye(3) - np.outer(place, place))


def true_inertia(plant: disturbances.Plant, model: Inertia) -> Inertia:
    """Return the inertia of the true robot: `model`, scaled by factors of `plant`, plus payload.

    By the parallel-axis theorem, the payload adds the inertia of a point mass m1 m2/(m1 + m2) at
    the distance between the robot's centre of mass and the payload.
    """
    mass, centre, inertia = model
    mass, apart = mass * plant.mass_factor, plant.payload_offset_m - centre
    total = mass + plant.payload_kg
    shared = point_inertia(mass * plant.payload_kg / total, apart)
    centre = centre + apart * plant.payload_kg / total
    return total, centre, inertia * plant.inertia_factor + shared


class Wind:
    """Horizontal wind: a mean velocity, and gusts that are a first-order Gauss-Markov process.

    Source: D. J. Moorhouse, R. J. Woodcock, "Background Information and User Guide for
    MIL-F-8785C", 1982: the process has the longitudinal Dryden spectrum.
    Deviation: both axes have this spectrum, with a given time constant.
    """

    def __init__(self, wind: disturbances.WindConfig, rng: np.random.Generator) -> None:
        self._mean, self._gust, self._time = wind.velocity_mps, wind.gust_mps, wind.gust_time_s
        self._rng, self._gusts = rng, self._gust * rng.standard_normal(2)

    def seen_from(self, readings: Readings, dt: float) -> Readings:
        """Return readings with the velocity relative to the air; advance the gusts by `dt` [s].

        Gusts w(t + dt) = a w(t) + s sqrt(1 - a^2) n, with a = exp(-dt/T); n is white noise, s the
        standard deviation of the gusts, T their time constant.
        """
        (x, y), (vx, vy, vz) = (self._mean + self._gusts).tolist(), readings.velocity
        if self._gust:
            keep = exp(-dt / self._time)
            noise = self._gust * sqrt(1.0 - keep * keep) * self._rng.standard_normal(2)
            self._gusts = keep * self._gusts + noise
        return readings._replace(velocity=(vx - x, vy - y, vz))
