"""Compile a robot and a scene into one MuJoCo model.

Both may be a user's own. Whether a controller can fly the robot is the controller's to say.
"""

from __future__ import annotations

from math import nan
from pathlib import Path
from typing import Any

import numpy as np

from cloudrc.config.schema import Plant
from cloudrc.errors import BadInputError
from cloudrc.geometry.compiled import compile_error, mujoco, read_scene
from cloudrc.geometry.scene import WORLD
from cloudrc.world.plant import Array, Inertia, point_inertia, true_inertia

ROBOT_PREFIX = "robot/"
"""Prefix of all names that belong to the robot in a compiled model."""
TIMESTEP = 0.002
"""Step of the physics [s]. Source: docs/reference/plant.md, "Physics step"."""
FUSES_WRONG = tuple(map(int, mujoco.__version__.split(".")[:2])) < (3, 11)
"""Whether MuJoCo computes a wrong inertia when it fuses static bodies, as it does up to 3.10."""


def compile_model(robot: Path, scene: Path) -> Any:
    """Attach the robot to the scene's frame `spawn` and compile both into an `MjModel`.

    `robot` and `scene` are MJCF files. In the result, names of the robot begin with `robot/`.
    Static bodies are fused, so that a step takes half the time. Fused bodies lose their names;
    therefore each geom of the scene gets the name BODY/NUMBER. Raise a BadInputError if a file is
    missing or does not compile, if the robot has no free base or no actuator, or if the scene has
    another time step.
    """
    model = _compile(robot, scene)
    _check_parts(model, robot, scene)
    if FUSES_WRONG:
        inertia = _inertia(_compile(robot, scene, fuse=False))
        model = _compile(robot, scene, inertia)
    return model


def compile_true(robot: Path, scene: Path, nominal: Any, plant: Plant) -> Any:
    """Return the model of the true robot, whose mass, inertia and thrust `plant` changes.

    `nominal` is the result of `compile_model` for the same files.
    """
    if plant == Plant():
        return nominal
    model = _compile(robot, scene, true_inertia(plant, _inertia(nominal)))
    model.actuator_gainprm[:, 0] *= plant.thrust_factor
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
        raise compile_error(f"{robot_path} in {scene_path}", error) from None


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
    base = mujoco.mjtJoint.mjJNT_FREE
    joints = model.jnt_type.tolist()
    if joints[:1] != [base] or joints.count(base) != 1:
        raise BadInputError(
            f"{robot_path} in {scene_path}: the robot's base must have a freejoint, "
            "and nothing else may move freely"
        )
    if not model.nu:
        raise BadInputError(f"{robot_path}: has no actuator, so that no controller can move it")
    if model.opt.timestep != TIMESTEP:
        raise BadInputError(
            f"{scene_path}: option timestep is {model.opt.timestep}, not {TIMESTEP}"
        )


def rotation(quaternion: Any) -> Any:
    """Return the rotation matrix of a unit quaternion (wxyz), shape (3, 3)."""
    axes = np.empty(9)
    mujoco.mju_quat2Mat(axes, quaternion)
    return axes.reshape(3, 3)
