# SPDX-License-Identifier: Apache-2.0

"""Compile a robot and a scene into one MuJoCo model.

Both may be a user's own. Whether a controller can fly the robot is the controller's to say.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from math import nan
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from cloudrc.base.outside.values import InvalidValueError
from cloudrc.base.text import unknown_name_text
from cloudrc.physics.geometry.scene import FLOOR, WORLD
from cloudrc.physics.sim.bodies import ROBOT_BITS, read_scene
from cloudrc.physics.sim.engine import JOINT, at_rest, compile_alone, compiling, mujoco
from cloudrc.physics.sim.plant import Array, Inertia, point_inertia, true_inertia

if TYPE_CHECKING:
    from cloudrc.config.camera import CameraConfig
    from cloudrc.config.disturbances import Plant
    from cloudrc.config.robot import SensorConfig

ROBOT_PREFIX = "robot/"
"""Prefix of all names that belong to the robot in a compiled model."""
TIMESTEP = 0.002
"""Step of the physics [s]. Source: docs/reference/plant.md, "Physics step"."""
NEEDED = {
    name: int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{name.upper()}"))
    for name in ("constraint", "contact", "gravity", "actuation", "sensor")
}
"""Flag of MuJoCo that a scene must not disable -> its bit: without contacts, for example, robots
fly through walls."""
MARGIN_MAX = 0.001
"""Largest `margin` and `gap` of a geom [m]: below the accuracy of a clearance."""
BITS = "give its geoms contype and conaffinity 1 and 1, or 0 and 0 if they are only seen"
INSIDE_MAX = 0.001
"""Largest depth by which a robot may start inside the floor [m]; the floor pushes it out gently."""


class OwnSensor(NamedTuple):
    """A sensor of the robot, which shows one number."""

    name: str  # in `robot.yaml`
    unit: str  # of its value
    address: int  # index of its value in MuJoCo's `sensordata`


def compile_model(robot: Path, scene: Path) -> Any:
    """Attach the robot to the scene's frame `spawn` and compile both into an `MjModel`.

    A robot that would be inside the floor there starts higher, on the floor.

    `robot` and `scene` are MJCF files. In the result, names of the robot begin with `robot/`. The
    robot may have joints of its own, such as those of wheels; its free joint comes first. Static
    bodies are fused, so that a step takes half the time. Fused bodies lose their names; therefore
    each geom of the scene gets the name BODY/NUMBER. Raise an InvalidValueError if a file is
    missing or does not compile, if the robot has no free base or no actuator or touches nothing, or
    if the scene has another time step or contacts that push at a distance.
    """
    model = _compile(robot, scene)
    # Attached to a scene, an element that names a missing one would vanish without a word.
    compile_alone(robot)
    _check_parts(model, robot, scene)
    return model


def compile_true(robot: Path, scene: Path, nominal: Any, plant: Plant) -> Any:
    """Return the model of the true robot, whose mass, inertia and actuators `plant` changes.

    `nominal` is the result of `compile_model` for the same files.
    """
    model = _compile(robot, scene, true_inertia(plant, _inertia(nominal)))
    base = model.jnt_bodyid[0]
    parts = (model.body_rootid == base) & (model.body_weldid != base)  # that move, such as wheels
    model.body_mass[parts] *= plant.mass_factor
    model.body_inertia[parts] *= plant.inertia_factor
    mujoco.mj_setConst(model, mujoco.MjData(model))
    scale = np.broadcast_to(np.array(plant.actuator_factor), (model.nu,))[:, None]
    for values in (model.actuator_gainprm, model.actuator_biasprm, model.actuator_forcerange):
        values *= scale  # the force is gain times control plus bias, in this range
    return model


def _compile(robot_path: Path, scene_path: Path, inertia: Inertia | None = None) -> Any:
    """Compile the robot in the scene; `inertia` replaces that of the robot's base, if given."""
    with compiling(f"{robot_path} in {scene_path}"):
        spec = read_scene(scene_path)
        # An empty prefix would make MuJoCo write MUJOCO_LOG.TXT into the working directory.
        robot = mujoco.MjSpec.from_file(str(robot_path))
        _take_options(robot, spec)
        spec.attach(robot, prefix=ROBOT_PREFIX, frame="spawn")
        for number, geom in enumerate(spec.worldbody.geoms):
            geom.name = f"{WORLD}/{number}"  # also geoms in the worldbody of the robot's file
        spec.compiler.fusestatic = True
        if inertia is not None:
            _set_inertia(_base(spec), *inertia)
        with warnings.catch_warnings():
            # Sizes in the robot's file, which the scene's replace.
            warnings.filterwarnings("ignore", "Attach conflict")
            model = spec.compile()
    _put_on_floor(model)
    return model


def _put_on_floor(model: Any) -> None:
    """Raise the start of a robot that reaches further down than the spawn is above the floor."""
    if model.njnt == 0 or model.jnt_type[0] != JOINT.mjJNT_FREE:
        return
    robot, depth = is_of_robot(model), 0.0
    for contact in at_rest(model).contact:
        first, second = contact.geom.tolist()
        other = second if robot[first] else first
        if robot[first] != robot[second] and model.geom(other).name.startswith(f"{FLOOR}/"):
            depth = max(depth, -contact.dist)
    if depth > INSIDE_MAX:
        model.qpos0[2] += depth
        model.body_pos[model.jnt_bodyid[0], 2] += depth


def _take_options(robot: Any, scene: Any) -> None:
    """Give a robot's file the options of the scene, which count: MuJoCo warns of others."""
    for name in (name for name in dir(scene.option) if not name.startswith("_")):
        setattr(robot.option, name, getattr(scene.option, name))
    robot.memory = scene.memory


def is_of_robot(model: Any) -> Any:
    """Return for each geom of a compiled model whether it belongs to the robot, shape (n,)."""
    base = model.jnt_bodyid[0]
    return model.body_rootid[model.geom_bodyid] == base


def bodies_of_geoms(model: Any) -> list[str]:
    """Return the name of the body of each geom in a compiled model, "" for geoms of the robot."""
    return [
        "" if is_robot else model.geom(number).name.rpartition("/")[0]
        for number, is_robot in enumerate(is_of_robot(model).tolist())
    ]


def find_part(model: Any, kind: str, name: str, key: str) -> int:
    """Return the number of the robot's `site`, `sensor` or `camera` of a name, which `key` gives.

    Raises:
        ValueError: If the robot has no such part.
    """
    count = model.ncam if kind == "camera" else getattr(model, f"n{kind}")
    names = [getattr(model, kind)(each).name for each in range(count)]
    if f"{ROBOT_PREFIX}{name}" in names:
        return names.index(f"{ROBOT_PREFIX}{name}")
    own = [each.removeprefix(ROBOT_PREFIX) for each in names if each.startswith(ROBOT_PREFIX)]
    raise InvalidValueError(f"{key}: {unknown_name_text(f'{kind} of the model', name, own)}")


def find_camera(model: Any, config: CameraConfig) -> int:
    """Return the number of the robot's camera in a compiled `MjModel`; `config` is of robot.yaml.

    Raises:
        ValueError: If the robot has no such camera, or one with another field of view.
    """
    number = find_part(model, "camera", config.name, "camera.name")
    fovy = float(model.cam_fovy[number])
    if fovy != config.fovy_deg:
        text = f"camera.fovy_deg is {config.fovy_deg:g}, but fovy of the model's camera is {fovy:g}"
        raise InvalidValueError(text)
    return number


def find_sensors(model: Any, asked: Mapping[str, SensorConfig]) -> tuple[OwnSensor, ...]:
    """Return the sensors that `robot.yaml` names, in its order.

    `model` is the compiled `MjModel` of robot and scene.

    Raises:
        ValueError: If the robot has no such sensor, or if the sensor shows several numbers.
    """
    found = []
    for name, each in asked.items():
        key = f"sensors.{name}.sensor"
        number = find_part(model, "sensor", each.sensor, key)
        if (count := int(model.sensor_dim[number])) != 1:
            text = f"{key}: {each.sensor} shows {count} numbers; name a sensor that shows one"
            raise InvalidValueError(text)
        found.append(OwnSensor(name, each.unit, int(model.sensor_adr[number])))
    return tuple(found)


def _base(spec: Any) -> Any:
    """Return the body with the free joint."""
    return next(joint.parent for joint in spec.joints if joint.type == JOINT.mjJNT_FREE)


def _inertia(model: Any) -> Inertia:
    """Return the inertia of the base and of what is fixed to it."""
    data, base = at_rest(model), model.jnt_bodyid[0]
    frame, bodies = data.xmat[base].reshape(3, 3), np.flatnonzero(model.body_weldid == base)
    masses, places = model.body_mass[bodies], (data.xipos[bodies] - data.xpos[base]) @ frame
    centre, inertia = masses @ places / masses.sum(), np.zeros((3, 3))
    for body, mass, place in zip(bodies, masses, places, strict=True):
        axes = frame.T @ data.ximat[body].reshape(3, 3)
        inertia += axes @ np.diag(model.body_inertia[body]) @ axes.T
        inertia += point_inertia(mass, place - centre)
    return masses.sum(), centre, inertia


def _set_inertia(base: Any, mass: float, centre: Array, inertia: Array) -> None:
    """Set the mass and inertia of the base body, and zero on the bodies that are fixed to it.

    `base` is the base body in an `MjSpec`. Bodies with a joint keep their inertia.
    """
    fixed = [base]
    for body in fixed:
        for geom in body.geoms:
            geom.mass = 0.0
        fixed += [child for child in body.bodies if not child.joints]
    for body in fixed[1:]:
        body.mass, body.inertia, body.fullinertia = 0.0, np.zeros(3), np.full(6, nan)
    moments, axes = np.linalg.eigh(inertia)
    axes[:, 0] *= np.linalg.det(axes)  # a rotation, not a mirror image
    base.iquat, base.fullinertia = np.empty(4), np.full(6, nan)
    mujoco.mju_mat2Quat(base.iquat, axes.ravel())
    base.mass, base.ipos, base.inertia, base.explicitinertial = mass, centre, moments, True


def _check_parts(model: Any, robot_path: Path, scene_path: Path) -> None:
    base, joints = JOINT.mjJNT_FREE, model.jnt_type.tolist()
    where = f"{robot_path} in {scene_path}"
    if joints[:1] != [base] or joints.count(base) != 1:
        raise InvalidValueError(
            f"{where}: the robot's base must have a freejoint, and nothing else may move freely"
        )
    off = [flag for flag, bit in NEEDED.items() if model.opt.disableflags & bit]
    if off:
        raise InvalidValueError(
            f"{scene_path}: option flag {off[0]} is disabled, which a flight needs; remove it"
        )
    if not model.nu:
        raise InvalidValueError(f"{robot_path}: has no actuator, so that no controller can move it")
    if model.opt.timestep != TIMESTEP:
        raise InvalidValueError(
            f"{scene_path}: option timestep is {model.opt.timestep}, not {TIMESTEP}"
        )
    _check_geoms(model, where)


def _check_geoms(model: Any, where: str) -> None:
    """Raise an error about contacts that path checks, clearances and notes do not know.

    With a margin, contacts do not begin at the surface. The checks know the scene alone: for them,
    a robot meets the geoms that have one of ROBOT_BITS.
    """
    types, affinities, robot = model.geom_contype, model.geom_conaffinity, is_of_robot(model)
    touching = (types | affinities) > 0
    far = np.maximum(np.abs(model.geom_margin), np.abs(model.geom_gap)) > MARGIN_MAX
    for geom in np.flatnonzero(far & touching):
        raise InvalidValueError(
            f"{where}: a geom of {model.geom(geom).name or 'the robot'} has a margin or gap, so "
            f"that contacts do not begin at the surface; give at most {MARGIN_MAX}"
        )
    if not (robot & touching).any():
        raise InvalidValueError(f"{where}: no geom of the robot can touch anything; {BITS}")
    expected = ((types | affinities) & ROBOT_BITS) > 0
    for geom in np.flatnonzero(robot & touching):
        meets = ((types[geom] & affinities) | (types & affinities[geom])) > 0
        if ((meets != expected) & ~robot).any():
            raise InvalidValueError(
                f"{where}: a geom of the robot has contype {types[geom]} and conaffinity "
                f"{affinities[geom]}, which do not fit those of the scene; {BITS}"
            )
