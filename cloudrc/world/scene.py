"""Compile a robot and a scene into one MuJoCo model.

Both may be a user's own. Whether a controller can fly the robot is the controller's to say.
"""

from __future__ import annotations

import warnings
from math import nan
from pathlib import Path
from typing import Any

import numpy as np

from cloudrc.config.problems import ConfigProblem, ProblemsError
from cloudrc.config.schema import Plant
from cloudrc.errors import BadInputError
from cloudrc.geometry.compiled import ROBOT_BITS, compile_error, mujoco, read_scene
from cloudrc.geometry.scene import FLOOR, WORLD
from cloudrc.world.plant import Array, Inertia, point_inertia, true_inertia

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
INSIDE_MAX = 0.001
"""Largest depth by which a robot may start inside the floor [m]; the floor pushes it out gently."""
FUSES_WRONG = tuple(map(int, mujoco.__version__.split(".")[:2])) < (3, 11)
"""Whether MuJoCo computes a wrong inertia when it fuses static bodies, as it does up to 3.10."""


def compile_model(robot: Path, scene: Path) -> Any:
    """Attach the robot to the scene's frame `spawn` and compile both into an `MjModel`.

    A robot that would be inside the floor there starts higher, on the floor.

    `robot` and `scene` are MJCF files. In the result, names of the robot begin with `robot/`. The
    robot may have joints of its own, such as those of wheels; its free joint comes first. Static
    bodies are fused, so that a step takes half the time. Fused bodies lose their names; therefore
    each geom of the scene gets the name BODY/NUMBER. Raise a BadInputError if a file is
    missing or does not compile, if the robot has no free base or no actuator or touches nothing, or
    if the scene has another time step or contacts that push at a distance.
    """
    model = _compile(robot, scene)
    _check_names(robot)
    _check_parts(model, robot, scene)
    if FUSES_WRONG:
        apart = _compile(robot, scene, fuse=False)
        # The inertia of a wheel with parts cannot be corrected on the base.
        model = apart if _has_joints(apart) else _compile(robot, scene, _inertia(apart))
    return model


def compile_true(robot: Path, scene: Path, nominal: Any, plant: Plant) -> Any:
    """Return the model of the true robot, whose mass, inertia and actuators `plant` changes.

    `nominal` is the result of `compile_model` for the same files. Raise a BadInputError if `plant`
    has factors for another number of actuators.
    """
    if plant == Plant():
        return nominal
    factors = plant.actuator_factor
    if isinstance(factors, tuple) and len(factors) != nominal.nu:
        reason = (
            f"has {len(factors)} factors, but {robot} has {nominal.nu} actuators; give as many, or "
            "one number for all"
        )
        path = "world", "plant", "actuator_factor"
        raise ProblemsError([ConfigProblem(path, "", reason)])
    fuse = not (FUSES_WRONG and _has_joints(nominal))
    model = _compile(robot, scene, true_inertia(plant, _inertia(nominal)), fuse=fuse)
    _scale_moving_parts(model, plant)
    scale = np.broadcast_to(np.array(factors), (model.nu,))[:, None]
    for values in (model.actuator_gainprm, model.actuator_biasprm, model.actuator_forcerange):
        values *= scale  # the force is gain times control plus bias, in this range
    return model


def _scale_moving_parts(model: Any, plant: Plant) -> None:
    """Scale mass and inertia of the robot's parts that move, such as wheels, as `plant` says."""
    base = model.jnt_bodyid[0]
    parts = (model.body_rootid == base) & (model.body_weldid != base)
    model.body_mass[parts] *= plant.mass_factor
    model.body_inertia[parts] *= plant.inertia_factor
    mujoco.mj_setConst(model, mujoco.MjData(model))


def _compile(
    robot_path: Path, scene_path: Path, inertia: Inertia | None = None, *, fuse: bool = True
) -> Any:
    """Compile the robot in the scene; `fuse` tells whether MuJoCo fuses static bodies.

    `inertia` replaces that of the robot's base; None keeps it.
    """
    try:
        spec = read_scene(scene_path)
        # An empty prefix would make MuJoCo write MUJOCO_LOG.TXT into the working directory, and
        # MuJoCo 3.3 crashes if a variable keeps the robot.
        robot = mujoco.MjSpec.from_file(str(robot_path))
        _take_options(robot, spec)
        spec.attach(robot, prefix=ROBOT_PREFIX, frame="spawn")
        for number, geom in enumerate(spec.worldbody.geoms):
            geom.name = f"{WORLD}/{number}"  # also geoms in the worldbody of the robot's file
        spec.compiler.fusestatic = fuse
        if inertia is not None:
            _set_inertia(_base(spec), *inertia)
        with warnings.catch_warnings():
            # Sizes in the robot's file, which the scene's replace.
            warnings.filterwarnings("ignore", "Attach conflict")
            model = spec.compile()
    except (ValueError, KeyError) as error:
        raise compile_error(f"{robot_path} in {scene_path}", error) from None
    _put_on_floor(model)
    return model


def _put_on_floor(model: Any) -> None:
    """Raise the start of a robot that reaches further down than the spawn is above the floor."""
    if model.njnt == 0 or model.jnt_type[0] != mujoco.mjtJoint.mjJNT_FREE:
        return
    bodies, data = bodies_of_geoms(model), mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_collision(model, data)
    depths = [
        -contact.dist
        for contact in data.contact
        if {bodies[geom] for geom in contact.geom.tolist()} == {"", FLOOR}
    ]
    depth = max(depths, default=0.0)
    if depth > INSIDE_MAX:
        model.qpos0[2] += depth
        model.body_pos[model.jnt_bodyid[0], 2] += depth


def _take_options(robot: Any, scene: Any) -> None:
    """Give a robot's file the options of the scene, which count: MuJoCo warns of others."""
    for name in (name for name in dir(scene.option) if not name.startswith("_")):
        setattr(robot.option, name, getattr(scene.option, name))
    robot.memory = scene.memory


def _check_names(robot_path: Path) -> None:
    """Refuse a robot with an element that names another, which the robot's file does not have.

    Attached to a scene, such an element, for example the actuator of a rotor, would vanish without
    a word.
    """
    try:
        mujoco.MjSpec.from_file(str(robot_path)).compile()
    except ValueError as error:
        raise compile_error(str(robot_path), error) from None


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


def _has_joints(model: Any) -> bool:
    """Return whether the robot has joints besides that of its base."""
    return bool(model.njnt > 1)


def _base(spec: Any) -> Any:
    """Return the body with the free joint."""
    free = mujoco.mjtJoint.mjJNT_FREE
    return next(joint.parent for joint in spec.joints if joint.type == free)


def _inertia(model: Any) -> Inertia:
    """Return the inertia of the base and of what is fixed to it."""
    data, base = mujoco.MjData(model), model.jnt_bodyid[0]
    mujoco.mj_forward(model, data)
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
    base = mujoco.mjtJoint.mjJNT_FREE
    joints = model.jnt_type.tolist()
    if joints[:1] != [base] or joints.count(base) != 1:
        raise BadInputError(
            f"{robot_path} in {scene_path}: the robot's base must have a freejoint, "
            "and nothing else may move freely"
        )
    off = [flag for flag, bit in NEEDED.items() if model.opt.disableflags & bit]
    if off:
        raise BadInputError(
            f"{scene_path}: option flag {off[0]} is disabled, which a flight needs; remove it"
        )
    if not model.nu:
        raise BadInputError(f"{robot_path}: has no actuator, so that no controller can move it")
    if model.opt.timestep != TIMESTEP:
        raise BadInputError(
            f"{scene_path}: option timestep is {model.opt.timestep}, not {TIMESTEP}"
        )
    _check_margins(model, robot_path, scene_path)
    _check_bits(model, robot_path, scene_path)


def _check_margins(model: Any, robot_path: Path, scene_path: Path) -> None:
    """Refuse contacts that begin at a distance from the surface: clearances would be wrong.

    Before MuJoCo 3.9 a contact pushes from `margin` - `gap`, since then from `margin`. A model
    with neither flies alike in all versions.
    """
    text = (
        f"so that contacts do not begin at the surface; remove both, or give at most {MARGIN_MAX}"
    )
    touchable = (model.geom_contype | model.geom_conaffinity) > 0
    for geom in np.flatnonzero(_is_off(model.geom_margin, model.geom_gap) & touchable)[:1]:
        body = bodies_of_geoms(model)[geom]
        where = f"{scene_path}: body {body}" if body else f"{robot_path}: the robot"
        numbers = f"margin {model.geom_margin[geom]:g} and gap {model.geom_gap[geom]:g}"
        raise BadInputError(f"{where} has a geom with {numbers}, {text}")
    if _is_off(model.pair_margin, model.pair_gap).any():
        raise BadInputError(f"{robot_path} in {scene_path}: a pair has a margin or gap, {text}")
    is_overriding = model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_OVERRIDE
    if is_overriding and abs(model.opt.o_margin) > MARGIN_MAX:
        raise BadInputError(
            f"{scene_path}: option o_margin is {model.opt.o_margin:g}, so that contacts do not "
            "begin at the surface; remove it"
        )


def _is_off(margins: Array, gaps: Array) -> Any:
    """Return for each geom whether its contacts may begin at a distance from its surface."""
    return np.maximum(np.abs(margins), np.abs(gaps)) > MARGIN_MAX


def _check_bits(model: Any, robot_path: Path, scene_path: Path) -> None:
    """Refuse a robot that meets other geoms than the path checks, clearances and notes say.

    These know the scene alone: for them, a robot meets the geoms that have one of ROBOT_BITS.
    """
    types, affinities = model.geom_contype, model.geom_conaffinity
    is_robot = is_of_robot(model)
    meeting = np.flatnonzero(is_robot & ((types | affinities) > 0)).tolist()
    if not meeting:
        raise BadInputError(
            f"{robot_path}: no geom of the robot can touch anything: their contype and conaffinity "
            "are 0; let some have 1 and 1"
        )
    for geom in meeting:
        meets = ((types[geom] & affinities) | (types & affinities[geom])) > 0
        expected = ((types | affinities) & ROBOT_BITS) > 0
        for other in np.flatnonzero((meets != expected) & ~is_robot)[:1].tolist():
            name = model.geom(geom).name.removeprefix(ROBOT_PREFIX) or geom
            raise BadInputError(
                f"{robot_path}: geom {name} has contype {types[geom]} and conaffinity "
                f"{affinities[geom]}, so that it {'meets' if meets[other] else 'never meets'} body "
                f"{bodies_of_geoms(model)[other]} of {scene_path} (contype {types[other]}, "
                f"conaffinity {affinities[other]}); give it 1 and 1, or 0 and 0 if it is only seen"
            )


def rotation(quaternion: Any) -> Any:
    """Return the rotation matrix of a unit quaternion (wxyz), shape (3, 3)."""
    axes = np.empty(9)
    mujoco.mju_quat2Mat(axes, quaternion)
    return axes.reshape(3, 3)
