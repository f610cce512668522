# SPDX-License-Identifier: Apache-2.0

"""Onboard controller: the published one, for the Pelican with its arm and four rotors.

Only robots of about its mass are accepted, because gains and allocation are those of its mass,
inertia and rotors.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from math import ceil
from statistics import fmean
from typing import Any

from cloudrc.config.schema import NotNegative, NotNegatives, World
from cloudrc.physics.sim.onboard import Accelerator
from cloudrc.robots.pelican.low_level import (
    GAIN_D,
    GAIN_I,
    GAIN_P,
    GRAVITY,
    INTEGRAL_LIMIT_XY,
    INTEGRAL_LIMIT_Z,
    MASS,
    ROBOT_GRAVITY,
    ROBOT_MASS,
    LowLevel,
)
from cloudrc.robots.pelican.rotors import STOPPED, Rotors
from cloudrc.wire.messages import Vector

MASS_SLACK = 0.1
"""Largest difference of the mass [kg]: the velocity loop compensates for a weight of 1 N."""
SAG_MAX = 0.05
"""Largest steady error of the position that needs no warning [m]."""
WIND_FORCE = 0.24
"""Horizontal force on a hovering robot per wind speed [N s/m]: two thirds are the drag of the
rotors, one third comes from the tilt that this drag causes."""


def build(
    model: Any,
    gain_p: NotNegatives = GAIN_P,
    gain_i: NotNegatives = GAIN_I,
    gain_d: NotNegatives = GAIN_D,
    integral_limit_xy: NotNegative = INTEGRAL_LIMIT_XY,
    integral_limit_z: NotNegative = INTEGRAL_LIMIT_Z,
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
        ValueError: If the model has another mass or number of rotors than the Pelican, or if the
            scene has air, whose drag the rotors would count twice.
    """
    if model.opt.density or model.opt.viscosity:
        raise ValueError(
            "the scene has the option density or viscosity, but the rotors of this robot have a "
            "drag of their own; fly another robot there"
        )
    mass = model.body_mass[model.jnt_bodyid[0]]
    if model.nu != len(STOPPED) or abs(mass - ROBOT_MASS) > MASS_SLACK:
        raise ValueError(
            f"needs 4 rotors and a mass of {ROBOT_MASS:g} +- {MASS_SLACK:g} kg, not {model.nu} "
            f"and {mass:g} kg; fly the model with the onboard controller multirotor"
        )
    return LowLevel(gain_p, gain_i, gain_d, integral_limit_xy, integral_limit_z)


def actuators(model: Any, dt: float) -> Rotors:
    """Make the rotors, which advance by `dt` [s] in a step."""
    return Rotors(dt)


def accelerator() -> Accelerator:
    """Return what runs the usual steps in C, if this machine can."""
    from cloudrc.robots.native.robot import accelerate
    from cloudrc.robots.pelican.twin import PelicanTwin

    return accelerate(PelicanTwin, "pelican", _example)


def _example(model: Any) -> tuple[LowLevel, Rotors]:
    return LowLevel(), Rotors(model.opt.timestep)


def advise(world: World, values: Mapping[str, Any], gains: Vector) -> Iterator[str]:
    """Yield advice if the integral of the velocity loop cannot balance wind or a changed weight.

    `values` are the parameters of `build`; `gains` are the cloud's velocities per distance from the
    setpoint [1/s], shape (3,), 0 if unknown.
    """
    plant = world.plant
    factors = plant.actuator_factor
    thrust = factors if isinstance(factors, float) else fmean(factors)
    weight = (ROBOT_MASS * plant.mass_factor + plant.payload_kg) * ROBOT_GRAVITY
    heavy = abs(weight / thrust - MASS * GRAVITY)
    drag = WIND_FORCE * max(map(abs, world.wind.velocity_mps))
    for name, axis, force in (("wind", 0, drag), ("plant", 2, heavy)):
        key = "integral_limit_z" if axis else "integral_limit_xy"
        gain, gain_i = values["gain_p"][axis] * gains[axis], values["gain_i"][axis]
        rest = force - gain_i * values[key]
        if rest > SAG_MAX * gain > 0.0 and gain_i:
            fits = round((ceil(force / gain_i / 0.1) + 1) * 0.1, 3)
            yield (
                f"the onboard controller does not know world.{name}, so the robot hovers about "
                f"{rest / gain:.2f} m from its setpoint; a value that fits: "
                f"--set world.onboard.{key}={fits:g}"
                + ("" if axis else " (above 0.3 a hostile cloud can leave the fence)")
            )
