"""Check whether a robot is enough like the Pelican for the published controller."""

from __future__ import annotations

from functools import cache
from math import inf
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from cloudrc.config.robot import find_robot
from cloudrc.config.shipped import file_of
from cloudrc.errors import BadInputError
from cloudrc.geometry.compiled import mujoco
from cloudrc.robots.pelican.low_level import GRAVITY, THRUST_MAX
from cloudrc.world.scene import ROBOT_PREFIX, compile_model, rotation

ROTORS = ("rotor_front", "rotor_left", "rotor_back", "rotor_right")
"""Names of the actuators. Every tuple of four rotor values has the same order."""
Facts: TypeAlias = dict[str, tuple[ArrayLike, ArrayLike]]
"""Name of a quantity, with its unit -> its value and the largest difference that is accepted."""


def check_fit(model: Any) -> None:
    """Raise a BadInputError that lists how a compiled model differs too much from the Pelican."""
    _check_parts(model)
    wanted = _wanted()
    differs = [
        f"{name} is {_words(have)}, not {_words(wanted[name][0])}"
        + (f" +- {_words(slack)}" if np.any(slack := wanted[name][1]) else "")
        for name, (have, _) in _facts(model).items()
        if not np.all(np.abs(np.subtract(have, wanted[name][0])) <= np.add(wanted[name][1], 1e-9))
    ]
    if differs:
        raise BadInputError(f"the onboard controller is not made for it: {'; '.join(differs)}")


def _check_parts(model: Any) -> None:
    """Raise a BadInputError if the model has other parts than the Pelican, or drag of the air."""
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


@cache
def _wanted() -> Facts:
    """Return the facts of the Pelican; its gravity is that which the controller assumes."""
    facts = _facts(compile_model(find_robot("pelican").model, file_of("empty")))
    return facts | {"gravity [m/s^2]": ((0.0, 0.0, -GRAVITY), 0.2)}


def _words(numbers: ArrayLike) -> str:
    return " ".join(f"{number:.4g}" for number in np.round(np.atleast_1d(numbers), 6) + 0.0)


def _facts(model: Any) -> Facts:
    """Return the quantities in which a robot must match the Pelican: name -> value, tolerance.

    Within the tolerances the Pelican's controller works: its velocity loop compensates for a
    weight that differs by 1 N, and its attitude gains work for an inertia that differs by 50 %.
    """
    base = model.jnt_bodyid[0]
    turned = rotation(model.body_iquat[base])
    inertia = np.diag(turned @ np.diag(model.body_inertia[base]) @ turned.T)
    facts: Facts = {
        "gravity [m/s^2]": (model.opt.gravity, 0.2),
        "mass [kg]": (model.body_mass[base], 0.1),
        "centre of mass [m]": (model.body_ipos[base], (0.01, 0.01, 0.03)),
        "inertia [kg m^2]": (inertia, 0.5 * inertia),
        "damping of the base": (model.dof_damping, 0.0),
        "tip [m]": (model.site(f"{ROBOT_PREFIX}tip").pos, 0.01),
    }
    for number, name in enumerate(ROTORS):
        site, gear = model.actuator_trnid[number, 0], model.actuator_gear[number]
        axes, low, high = rotation(model.site_quat[site]), -inf, inf
        for kind in ("ctrl", "force"):
            if getattr(model, f"actuator_{kind}limited")[number]:
                limits = getattr(model, f"actuator_{kind}range")[number]
                low, high = max(low, limits[0]), min(high, limits[1])
        facts |= {
            f"{name} place [m]": (model.site_pos[site], 0.01),
            f"{name} gear, thrust": (axes @ gear[:3], 0.01),
            f"{name} gear, torque [m]": (axes @ gear[3:], 0.001),
            f"{name} gain": (model.actuator_gainprm[number, 0], 0.01),
            f"{name} biastype": (model.actuator_biastype[number], 0.0),
            f"{name} dyntype": (model.actuator_dyntype[number], 0.0),
            # A wider range than needed makes no difference.
            f"{name} range [N]": (np.clip((low, high), (0.0, -inf), (inf, THRUST_MAX)), 0.0),
        }
    return facts
