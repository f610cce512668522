"""Check whether a robot is enough like the Pelican for the published controller."""

from __future__ import annotations

from typing import Any

from cloudrc.errors import BadInputError
from cloudrc.geometry.compiled import mujoco
from cloudrc.robots.pelican.low_level import GRAVITY, ROBOT_MASS
from cloudrc.world.scene import ROBOT_PREFIX

ROTORS = ("rotor_front", "rotor_left", "rotor_back", "rotor_right")
"""Names of the actuators. Every tuple of four rotor values has the same order."""
MASS_SLACK = 0.1
"""Largest difference of the mass [kg]: the velocity loop compensates for a weight of 1 N."""
GRAVITY_SLACK = 0.2
"""Largest difference of the gravity from that which the controller assumes [m/s^2]."""


def check_fit(model: Any) -> None:
    """Raise a BadInputError if a compiled `MjModel` differs too much from the Pelican.

    Its parts, mass and gravity decide; there may be no air, whose drag the rotors would count
    twice.
    """
    for option in ("density", "viscosity"):
        if value := getattr(model.opt, option):
            raise BadInputError(
                f"the scene's option {option} is {value:g}; this robot has its own drag of the "
                "air, so leave the option out"
            )
    actuators = [model.actuator(number).name for number in range(model.nu)]
    if actuators != [f"{ROBOT_PREFIX}{rotor}" for rotor in ROTORS]:
        raise BadInputError(f"needs the actuators {', '.join(ROTORS)}, in this order")
    if (model.actuator_trntype != mujoco.mjtTrn.mjTRN_SITE).any():
        raise BadInputError("each actuator must act at a site")
    for kind in ("site", "sensor"):
        try:
            getattr(model, kind)(f"{ROBOT_PREFIX}tip")
        except KeyError:
            raise BadInputError(f"needs a {kind} named tip") from None
    if (model.nq, model.nv) != (7, 6):
        raise BadInputError("nothing but the robot's base may move")
    mass, gravity = model.body_mass[model.jnt_bodyid[0]], -model.opt.gravity[2]
    if abs(mass - ROBOT_MASS) > MASS_SLACK or abs(gravity - GRAVITY) > GRAVITY_SLACK:
        raise BadInputError(
            f"the onboard controller is made for a mass of {ROBOT_MASS:g} +- {MASS_SLACK:g} kg and "
            f"a gravity of {GRAVITY:g} +- {GRAVITY_SLACK:g} m/s^2, not {mass:g} and {gravity:g}; "
            "fly the model with the onboard controller multirotor"
        )
