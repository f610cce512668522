# SPDX-License-Identifier: Apache-2.0

"""Measure the mechanical energy of a robot's rotors, from their thrusts and speeds."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from cloudrc.physics.sim.plant import Array


class EnergyMeter:
    """Adds up the energy of the rotors of a simulated robot, from samples of their thrusts.

    A rotor with the thrust f = k w^2, the speed w and the reaction torque q needs the power q w =
    q sqrt(f/k). What is lost in the motor, and what speeds up the rotor, are left out.
    Source: J. G. Leishman, "Principles of Helicopter Aerodynamics", Cambridge University Press,
    2nd edition 2006, chapter 2 (power = torque times speed); R. Mahony, V. Kumar, P. Corke,
    "Multirotor aerial vehicles", IEEE Robotics & Automation Magazine 19 (3), 2012 (f = k w^2).

    Attributes:
        sample: Stores the present thrusts.
    """

    def __init__(self, data: Any, factors: Array) -> None:
        """Begin with 0 J; `data` is an `MjData`, `factors` [W/N^1.5] those of `power_factors`."""
        self._samples, self._factors, self._energy = array("d"), factors, 0.0
        forces = memoryview(data.actuator_force).cast("B")
        self.sample: Callable[[], None] = partial(self._samples.frombytes, forces)

    def read(self, period: float) -> float:
        """Return the energy of all samples [J], which are `period` [s] apart."""
        thrusts = np.abs(np.array(self._samples).reshape(-1, len(self._factors)))
        self._energy += float((thrusts * np.sqrt(thrusts) * self._factors).sum()) * period
        del self._samples[:]
        return self._energy


def power_factors(model: Any, nominal: Any, coefficient: float | None) -> Array | None:
    """Return the power of each rotor per 1.5th power of its thrust [W/N^1.5], shape (n,).

    Return None if a speed or a torque is not known. `model` is the `MjModel` of the true robot,
    whose rotors give another thrust at the same speed than those of the `nominal` one;
    `coefficient` is k of the nominal rotors [N s^2]. Torque and thrust are in the actuators' gear.
    """
    thrust, torque = np.split(model.actuator_gear, 2, axis=1)
    torque = np.linalg.norm(torque, axis=1)
    if coefficient is None or not torque.all():
        return None
    weaker = model.actuator_gainprm[:, 0] / nominal.actuator_gainprm[:, 0]
    factors: Array = torque * np.sqrt(np.linalg.norm(thrust, axis=1) / (weaker * coefficient))
    return factors
