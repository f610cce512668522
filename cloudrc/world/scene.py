"""Compile a robot and a scene into one MuJoCo model.

The robot may be a user's own model. The onboard controller and the rotors are made for the robot
`pelican`. A model that differs too much from it is refused, and the message lists the differences.
"""

from __future__ import annotations

from math import inf, nan
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from cloudrc.config.schema import Plant
from cloudrc.config.shipped import file_of
from cloudrc.errors import BadInputError
from cloudrc.geometry.compiled import mujoco, read_scene
from cloudrc.geometry.scene import WORLD
from cloudrc.robots.pelican.onboard import GRAVITY, THRUST_MAX
from cloudrc.world.plant import Array, Inertia, point_inertia, true_inertia

ROBOT_PREFIX = "robot/"
"""Prefix of all names that belong to the robot in a compiled model."""
ROTORS = ("rotor_front", "rotor_left", "rotor_back", "rotor_right")
"""Names of a robot's actuators. Every tuple of four rotor values has the same order."""
TIMESTEP = 0.002
"""Step of the physics [s]. Source: docs/reference/plant.md, "Physics step"."""
PELICAN = file_of("robot", "pelican")
"""The robot for which the onboard controller is made."""
Facts: TypeAlias = dict[str, tuple[ArrayLike, ArrayLike]]
"""Name of a quantity, with its unit -> its value and the largest difference that is accepted."""


FUSES_WRONG = tuple(map(int, mujoco.__version__.split(".")[:2])) < (3, 11)
"""Whether MuJoCo computes a wrong inertia when it fuses static bodies, as it does up to 3.10."""


def compile_model(robot: str, scene: str, plant: Plant | None = None) -> Any:
    """Attach the robot to the scene's frame `spawn` and compile both into an `MjModel`.

    `robot` and `scene` are names of shipped models or paths of files. In the result, names of the
    robot begin with `robot/`. Static bodies are fused, so that a step takes half the time. Fused
    bodies lose their names; therefore each geom of the scene gets the name BODY/NUMBER. Raise a
    BadInputError if a file is missing, does not compile or does not fit the onboard controller.

    After the check of the files, `plant` changes mass, inertia and thrust: the true robot may
    differ from its file.
    """
    paths = file_of("robot", robot), file_of("scene", scene)
    model = _compile_nominal(*paths)
    gravity: Facts = {"gravity [m/s^2]": (model.opt.gravity, 0.0)}
    _refuse_differences(paths[1], gravity, {"gravity [m/s^2]": ((0.0, 0.0, -GRAVITY), 0.2)})
    if paths[0] != PELICAN:
        _refuse_differences(paths[0], _facts(model), _facts(_compile_nominal(PELICAN, paths[1])))
    if plant is not None and plant != Plant():
        model = _compile(*paths, true_inertia(plant, _inertia(model)))
        model.actuator_gainprm[:, 0] *= plant.thrust_factor
    return model


def _compile_nominal(robot_path: Path, scene_path: Path) -> Any:
    model = _compile(robot_path, scene_path)
    _check_parts(model, robot_path, scene_path)
    if FUSES_WRONG:
        inertia = _inertia(_compile(robot_path, scene_path, fuse=False))
        model = _compile(robot_path, scene_path, inertia)
    return model


def _compile(
    robot_path: Path, scene_path: Path, inertia: Inertia | None = None, *, fuse: bool = True
) -> Any:
    """Compile the robot in the scene; `fuse` tells whether MuJoCo fuses static bodies.

    `inertia` replaces the robot's inertia; None keeps it.
    """
    try:
        spec = read_scene(scene_path)
        # An empty prefix would make MuJoCo write MUJOCO_LOG.TXT into the working directory, and
        # MuJoCo 3.3 crashes if a variable keeps the robot.
        spec.attach(mujoco.MjSpec.from_file(str(robot_path)), prefix=ROBOT_PREFIX, frame="spawn")
        for number, geom in enumerate(spec.worldbody.geoms):
            geom.name = f"{WORLD}/{number}"  # also geoms in the worldbody of the robot's file
        spec.compiler.fusestatic = fuse
        if inertia is not None:
            _set_inertia(spec.joints[0].parent, *inertia)
        return spec.compile()
    except (ValueError, KeyError) as error:
        reason = " ".join(str(error).split())
        raise BadInputError(f"{robot_path} in {scene_path} does not compile: {reason}") from None


def is_of_robot(model: Any) -> Any:
    """Return for each geom of a compiled model whether it belongs to the robot, shape (n,)."""
    base = model.jnt_bodyid[0]
    return model.body_rootid[model.geom_bodyid] == base


def bodies_of_geoms(model: Any) -> list[str]:
    """Return the name of the body of each geom in a compiled model, "" for geoms of the robot."""
    return [
        "" if is_robot else model.geom(number).name.rpartition("/")[0]
        for number, is_robot in enumerate(is_of_robot(model))
    ]


def _inertia(model: Any) -> Inertia:
    data, base = mujoco.MjData(model), model.jnt_bodyid[0]
    mujoco.mj_forward(model, data)
    frame, bodies = data.xmat[base].reshape(3, 3), np.flatnonzero(model.body_rootid == base)
    masses, places = model.body_mass[bodies], (data.xipos[bodies] - data.xpos[base]) @ frame
    centre, inertia = masses @ places / masses.sum(), np.zeros((3, 3))
    for body, mass, place in zip(bodies, masses, places, strict=True):
        axes = frame.T @ data.ximat[body].reshape(3, 3)
        inertia += axes @ np.diag(model.body_inertia[body]) @ axes.T
        inertia += point_inertia(mass, place - centre)
    return masses.sum(), centre, inertia


def _set_inertia(base: Any, mass: float, centre: Array, inertia: Array) -> None:
    """Set the mass and inertia of the whole robot on its base body, and zero on all other bodies.

    `base` is the base body in an `MjSpec`.
    """
    for geom in base.find_all("geom"):
        geom.mass = 0.0
    for body in base.find_all("body"):
        body.mass, body.inertia, body.fullinertia = 0.0, np.zeros(3), np.full(6, nan)
    moments, axes = np.linalg.eigh(inertia)
    axes[:, 0] *= np.linalg.det(axes)  # a rotation, not a mirror image
    base.iquat, base.fullinertia = np.empty(4), np.full(6, nan)
    mujoco.mju_mat2Quat(base.iquat, axes.ravel())
    base.mass, base.ipos, base.inertia, base.explicitinertial = mass, centre, moments, True


def _check_parts(model: Any, robot_path: Path, scene_path: Path) -> None:
    actuators = [model.actuator(number).name for number in range(model.nu)]
    if actuators != [f"{ROBOT_PREFIX}{rotor}" for rotor in ROTORS]:
        raise BadInputError(f"{robot_path}: needs the actuators {', '.join(ROTORS)}, in this order")
    if (model.actuator_trntype != mujoco.mjtTrn.mjTRN_SITE).any():
        raise BadInputError(f"{robot_path}: each actuator must act at a site")
    for kind in ("site", "sensor"):
        try:
            getattr(model, kind)(f"{ROBOT_PREFIX}tip")
        except KeyError:
            raise BadInputError(f"{robot_path}: needs a {kind} named tip") from None
    if (model.nq, model.nv) != (7, 6):
        raise BadInputError(
            f"{robot_path} in {scene_path}: the robot's base must have a freejoint, "
            "and nothing else may move"
        )
    if model.opt.timestep != TIMESTEP:
        raise BadInputError(
            f"{scene_path}: option timestep is {model.opt.timestep}, not {TIMESTEP}"
        )


def _refuse_differences(path: Path, found: Facts, wanted: Facts) -> None:
    differs = [
        f"{name} is {_words(have)}, not {_words(right)}"
        + (f" +- {_words(slack)}" if np.any(slack) else "")
        for (name, (have, _)), (right, slack) in zip(found.items(), wanted.values(), strict=True)
        if not np.all(np.abs(np.subtract(have, right)) <= np.add(slack, 1e-9))
    ]
    if differs:
        raise BadInputError(
            f"{path}: the onboard controller is not made for it: {'; '.join(differs)}"
        )


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


def rotation(quaternion: Any) -> Any:
    """Return the rotation matrix of a unit quaternion (wxyz), shape (3, 3)."""
    axes = np.empty(9)
    mujoco.mju_quat2Mat(axes, quaternion)
    return axes.reshape(3, 3)
