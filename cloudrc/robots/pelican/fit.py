"""Check whether a robot is enough like the Pelican for the published controller."""

from __future__ import annotations

from typing import Any

from cloudrc.robots.pelican.low_level import GRAVITY, ROBOT_MASS
from cloudrc.sim.scene import ROBOT_PREFIX

ROTORS = ("rotor_front", "rotor_left", "rotor_back", "rotor_right")
"""Names of the actuators. Every tuple of four rotor values has the same order."""
MASS_SLACK = 0.1
"""Largest difference of the mass [kg]: the velocity loop compensates for a weight of 1 N."""
GRAVITY_SLACK = 0.2
"""Largest difference of the gravity from that which the controller assumes [m/s^2]."""


def check_fit(model: Any) -> None:
    """Raise a ValueError if a compiled `MjModel` differs too much from the Pelican.

    Its parts, mass and gravity decide; there may be no air, whose drag the rotors would count
    twice.
    """
    if model.opt.density or model.opt.viscosity:
        raise ValueError(
            "the scene has the option density or viscosity; this robot has its own drag of the "
            "air, so leave the option out"
        )
    names = {
        kind: [getattr(model, kind)(n).name for n in range(getattr(model, f"n{short}"))]
        for kind, short in (("actuator", "u"), ("site", "site"), ("sensor", "sensor"))
    }
    tip = f"{ROBOT_PREFIX}tip"
    rotors = [f"{ROBOT_PREFIX}{rotor}" for rotor in ROTORS]
    has_parts = names["actuator"] == rotors and tip in names["site"] and tip in names["sensor"]
    if not has_parts or (model.nq, model.nv) != (7, 6):
        raise ValueError(
            f"needs the actuators {', '.join(ROTORS)}, in this order, a site and a sensor named "
            "tip, and no other joint than that of the base"
        )
    mass, gravity = model.body_mass[model.jnt_bodyid[0]], -model.opt.gravity[2]
    if abs(mass - ROBOT_MASS) > MASS_SLACK or abs(gravity - GRAVITY) > GRAVITY_SLACK:
        raise ValueError(
            f"the onboard controller is made for a mass of {ROBOT_MASS:g} +- {MASS_SLACK:g} kg and "
            f"a gravity of {GRAVITY:g} +- {GRAVITY_SLACK:g} m/s^2, not {mass:g} and {gravity:g}; "
            "fly the model with the onboard controller multirotor"
        )
