"""Compile a robot and a scene into one MuJoCo model.

The robot may be a user's own model. The onboard controller and the rotors assume fixed numbers,
such as the mass. A model with other numbers is refused, and the message lists the differences.
Other modules of `world` import `mujoco` from here, because this module imports it without OpenGL.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable
from math import nan
from pathlib import Path
from typing import Any

import numpy as np

from cloudrc.config.schema import Plant
from cloudrc.errors import BadInputError, MissingPrerequisiteError
from cloudrc.world.low_level import GRAVITY, MASS, THRUST_MAX
from cloudrc.world.plant import Array, Inertia, point_inertia, true_inertia
from cloudrc.world.rotors import ARM, HEIGHT, TORQUE_RATIO

ROBOT_PREFIX = "robot/"
"""Prefix of all names that belong to the robot in a compiled model."""
ROTORS = ("rotor_front", "rotor_left", "rotor_back", "rotor_right")
"""Names of a robot's actuators. Every tuple of four rotor values has the same order."""
TIMESTEP = 0.002
"""Step of the physics [s]. Source: docs/reference/plant.md, "Physics step"."""
INERTIA = (0.0121, 0.0116, 0.0226)
"""Inertia about x, y, z for which the attitude gains were tuned: the pelican's [kg m^2]."""
TIP = (0.40, 0.0, 0.17)
"""Position of the arm's tip that a robot model must have [m], body frame."""
FOLDER = Path(__file__).parent


def import_mujoco() -> Any:
    """Import MuJoCo without OpenGL, which a flight does not need.

    With MUJOCO_GL=egl and no libEGL, `import mujoco` fails. MUJOCO_GL is therefore `disable` during
    the import. Afterwards it has its old value, for a child process that renders.
    """
    wanted = os.environ.get("MUJOCO_GL")
    os.environ["MUJOCO_GL"] = "disable"
    try:
        import mujoco
    except ImportError as error:
        raise MissingPrerequisiteError(
            f"the simulator needs MuJoCo ({error}); run: pip install 'cloudrc[world]'"
        ) from None
    finally:
        del os.environ["MUJOCO_GL"]
        if wanted is not None:
            os.environ["MUJOCO_GL"] = wanted
    return mujoco


mujoco = import_mujoco()
FUSES_WRONG = tuple(map(int, mujoco.__version__.split(".")[:2])) < (3, 11)
"""Whether MuJoCo computes a wrong inertia when it fuses static bodies, as it does up to 3.10."""
# Otherwise MuJoCo writes its warnings to MUJOCO_LOG.TXT in the working directory.
mujoco.set_mju_user_warning(logging.getLogger("mujoco").warning)


def model_path(kind: str, name: str) -> Path:
    """Find a shipped model by its name, or a user's model by the path of its .xml file.

    `kind` is "robots" or "scenes". A missing file raises a BadInputError.
    """
    path = Path(name) if name.endswith(".xml") else FOLDER / kind / f"{name}.xml"
    if not path.is_file():
        shipped = ", ".join(sorted(file.stem for file in (FOLDER / kind).glob("*.xml")))
        raise BadInputError(f"no {kind[:-1]} named {name!r}; available: {shipped}, or an .xml file")
    return path


def compile_model(robot: str, scene: str, plant: Plant | None = None) -> Any:
    """Attach the robot to the scene's frame `spawn` and compile both into an `MjModel`.

    `robot` and `scene` are names of shipped models or paths of files. In the result, names of the
    robot begin with `robot/`. Static bodies are fused, so that a step takes half the time. Fused
    bodies lose their names; therefore each geom of the scene gets the name BODY/NUMBER. Raise a
    BadInputError if a file is missing, does not compile or does not fit the onboard controller.

    With `plant`, the result is the true robot. The check of the files ignores `plant`.
    """
    paths = model_path("robots", robot), model_path("scenes", scene)
    model = _compile(*paths)
    _check_parts(model, *paths)
    if FUSES_WRONG:
        model = _compile(*paths, _inertia(_compile(*paths, fuse=False)))
    _check_numbers(model, *paths)
    if plant is not None and plant != Plant():
        model = _compile(*paths, true_inertia(plant, _inertia(model)))
        model.actuator_gainprm[:, 0] *= plant.thrust_factor
    return model


def _compile(
    robot_path: Path, scene_path: Path, inertia: Inertia | None = None, *, fuse: bool = True
) -> Any:
    """Compile the robot in the scene, with another `inertia` of the robot if it is given."""
    try:
        spec = mujoco.MjSpec.from_file(str(scene_path))
        for number, geom in enumerate(spec.geoms):
            geom.name = f"{geom.parent.name or 'unnamed'}/{number}"
        if spec.frame("spawn") is None:
            raise BadInputError(f"{scene_path}: needs a frame named spawn in its worldbody")
        if spec.body("floor") is None:
            raise BadInputError(
                f"{scene_path}: needs a body named floor; other bodies are obstacles"
            )
        # An empty prefix would make MuJoCo write MUJOCO_LOG.TXT into the working directory.
        spec.attach(mujoco.MjSpec.from_file(str(robot_path)), prefix=ROBOT_PREFIX, frame="spawn")
        spec.compiler.fusestatic = fuse
        if inertia is not None:
            _set_inertia(spec.joints[0].parent, *inertia)
        return spec.compile()
    except (ValueError, KeyError) as error:
        reason = " ".join(str(error).split())
        raise BadInputError(f"{robot_path} in {scene_path} does not compile: {reason}") from None


def _inertia(model: Any) -> Inertia:
    """Compute the inertia of the robot, which may have several bodies."""
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
    """Give the base of an `MjSpec` the inertia of the whole robot, and its other bodies none."""
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


def _check_numbers(model: Any, robot_path: Path, scene_path: Path) -> None:
    gravity = _compare("gravity [m/s^2]", -model.opt.gravity[2:], [GRAVITY], 0.02 * GRAVITY)
    for path, differs in ((robot_path, _robot_differences(model)), (scene_path, gravity)):
        if differs:
            raise BadInputError(
                f"{path}: the onboard controller is not made for it: {'; '.join(differs)}"
            )


def _compare(name: str, found: Iterable[float], wanted: Iterable[float], slack: float) -> list[str]:
    """List in words the values of `found` that differ from `wanted` by more than `slack`.

    AXIS in the quantity's `name` stands for x, y and z, one for each value.
    """
    return [
        f"{name.replace('AXIS', axis)} is {have:.4g}, not {want:g} +- {slack:.2g}"
        for axis, have, want in zip("xyz", found, wanted, strict=False)
        if not abs(have - want) <= slack
    ]


def _robot_differences(model: Any) -> list[str]:
    """List in words where a robot differs from what the onboard controller and the rotors assume.

    Differences that the controller can handle are accepted: the velocity loop compensates for a
    weight that differs by 1 N, and the attitude gains work for an inertia that differs by 50 %.
    """
    base = model.jnt_bodyid[0]
    turned, centre = rotation(model.body_iquat[base]), model.body_ipos[base]
    inertia = np.diag(turned @ np.diag(model.body_inertia[base]) @ turned.T)
    differs = _compare("mass [kg]", model.body_mass[[base]], [MASS], 0.1 * MASS)
    differs += _compare("centre of mass, AXIS [m]", centre[:2], (0.0, 0.0), 0.01)
    differs += _compare("centre of mass, z [m]", centre[2:], [0.0], 0.03)
    for axis, found, wanted in zip("xyz", inertia, INERTIA, strict=True):
        differs += _compare(f"inertia about {axis} [kg m^2]", [found], [wanted], 0.5 * wanted)
    if model.dof_damping.any():
        differs.append(f"damping of the base is {max(model.dof_damping):.4g}, not 0")
    differs += _compare("tip, AXIS [m]", model.site(f"{ROBOT_PREFIX}tip").pos, TIP, 0.01)
    for number, (x, y) in enumerate(((ARM, 0.0), (0.0, ARM), (-ARM, 0.0), (0.0, -ARM))):
        differs += _rotor_differences(model, number, (x, y, HEIGHT), 1 if x else -1)
    return differs


def _rotor_differences(
    model: Any, number: int, place: tuple[float, float, float], sign: int
) -> list[str]:
    """List in words where an actuator differs from the rotor at `place` [m], body frame.

    `sign` is the sign of the rotor's reaction torque about z.
    """
    name = ROTORS[number]
    if model.actuator_trntype[number] != mujoco.mjtTrn.mjTRN_SITE:
        return [f"{name} transmission is {model.actuator_trntype[number]}, not a site"]
    site, gear = model.actuator_trnid[number, 0], model.actuator_gear[number]
    axes, torque = rotation(model.site_quat[site]), (0.0, 0.0, sign * TORQUE_RATIO)
    differs = [
        *_compare(f"{name} place, AXIS [m]", model.site_pos[site], place, 0.01),
        *_compare(f"{name} gear, thrust along AXIS", axes @ gear[:3], (0.0, 0.0, 1.0), 0.01),
        *_compare(f"{name} gear, torque about AXIS [m]", axes @ gear[3:], torque, 0.001),
        *_compare(f"{name} gain", model.actuator_gainprm[number, :1], [1.0], 0.01),
    ]
    for kind in ("bias", "dyn"):
        if found := getattr(model, f"actuator_{kind}type")[number]:
            differs.append(f"{name} {kind}type is {found}, not 0 (none)")
    for kind in ("ctrl", "force"):
        low, high = getattr(model, f"actuator_{kind}range")[number]
        if getattr(model, f"actuator_{kind}limited")[number]:
            if high < THRUST_MAX:
                wide = f"at least {THRUST_MAX:.3g}, the largest thrust"
                differs.append(f"{name} {kind}range, end [N] is {high:.4g}, not {wide}")
            if low > 0.0:
                differs.append(f"{name} {kind}range, begin [N] is {low:.4g}, not 0 or less")
    return differs


def rotation(quaternion: Any) -> Any:
    """Return the rotation matrix of a unit quaternion (wxyz), shape (3, 3)."""
    axes = np.empty(9)
    mujoco.mju_quat2Mat(axes, quaternion)
    return axes.reshape(3, 3)
