"""Onboard controller: the published one, for the Pelican with its arm and four rotors.

Only models that differ little from the Pelican are accepted, because gains and allocation are those
of its mass, inertia and rotors.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from cloudrc.messages import Vector
from cloudrc.robots.pelican.fit import check_fit
from cloudrc.robots.pelican.low_level import LowLevel
from cloudrc.robots.pelican.rotors import Rotors

if TYPE_CHECKING:
    from cloudrc.world.guard.state import Guard
    from cloudrc.world.robot import Robot
    from cloudrc.world.simulator import Simulator


def build(
    model: Any,
    gain_p: Vector = (4.0, 4.0, 10.0),
    gain_i: Vector = (1.0, 1.0, 2.5),
    gain_d: Vector = (0.30, 0.30, 0.50),
    integral_limit_xy: float = 0.10,
    integral_limit_z: float = 0.40,
) -> LowLevel:
    """Make the controller for a compiled `MjModel`.

    Args:
        model: The robot in its scene.
        gain_p: Force per velocity error [N s/m], shape (3,).
        gain_i: Force per integrated velocity error [N/m], shape (3,).
        gain_d: Force per rate of the velocity error [N s^2/m], shape (3,).
        integral_limit_xy: Limit of the integrated velocity error in x and y [m].
        integral_limit_z: Limit of the integrated velocity error in z [m].

    Raises:
        BadInputError: If the model differs too much from the Pelican.
    """
    check_fit(model)
    return LowLevel(gain_p, gain_i, gain_d, integral_limit_xy, integral_limit_z)


def actuators(model: Any, dt: float) -> Rotors:
    """Make the rotors, which advance by `dt` [s] in a step."""
    return Rotors(dt)


def accelerate(simulator: Simulator, onboard: LowLevel, guard: Guard) -> Robot:
    """Make a robot that runs its usual steps in C if this machine can, with the same results."""
    from cloudrc.robots.pelican.native.robot import make_robot

    return make_robot(simulator, onboard, guard)
