"""Compile a robot and a scene into one MuJoCo model.

The robot may be a user's own model. The onboard controller and the rotors assume fixed numbers,
such as the mass. A robot with other numbers would fly badly or not at all. Therefore this module
refuses such a robot, and the message lists the differences.

The other modules of `world` do not import the package `mujoco`; they use this module's import.
"""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cloudrc.errors import BadInputError, MissingPrerequisiteError
from cloudrc.world.low_level import GRAVITY, MASS, THRUST_MAX
from cloudrc.world.rotors import ARM, HEIGHT, TORQUE_RATIO

ROBOT_PREFIX = "robot/"
"""Prefix of all names that belong to the robot in a compiled model."""
ROTORS = ("rotor_front", "rotor_left", "rotor_back", "rotor_right")
"""Names of a robot's actuators. Every tuple of four rotor values has the same order."""
TIMESTEP = 0.002
"""Step of the physics and of the onboard part [s].
Source: docs/reference/plant.md, "Physics step"."""
INERTIA = (0.0121, 0.0116, 0.0226)
"""Inertia about x, y, z for which the attitude gains were tuned [kg m^2]: the pelican's inertia."""
TIP = (0.40, 0.0, 0.17)
"""Position of the arm's tip, from which clearance is computed [m], body frame."""
SHOWN = 6
"""Largest number of differences that one message lists [1]."""
FOLDER = Path(__file__).parent
_NO_GL = {"", "disable", "disabled", "off", "false", "0"}


def import_mujoco() -> Any:
    """Import MuJoCo without OpenGL, which a flight does not need.

    With MUJOCO_GL=egl and no libEGL, `import mujoco` fails. Therefore MUJOCO_GL is `disable`
    during the import. Its value is restored afterwards, for a child process that renders.

    Raises:
        MissingPrerequisiteError: If the package is not installed.
    """
    wanted = os.environ.get("MUJOCO_GL")
    if "mujoco" not in sys.modules and (wanted or "").lower() not in _NO_GL:
        logging.getLogger(__name__).warning(
            "MUJOCO_GL=%s ignored: a flight needs no OpenGL", wanted
        )
    os.environ["MUJOCO_GL"] = "disable"
    try:
        import mujoco
    except ImportError as error:
        raise MissingPrerequisiteError(
            f"the simulator needs MuJoCo ({error}); run: pip install 'cloudrc[world]'"
        ) from None
    finally:
        if wanted is None:
            del os.environ["MUJOCO_GL"]
        else:
            os.environ["MUJOCO_GL"] = wanted
    return mujoco


mujoco = import_mujoco()
# Otherwise MuJoCo writes its warnings to MUJOCO_LOG.TXT in the working directory.
mujoco.set_mju_user_warning(logging.getLogger("mujoco").warning)


def model_path(kind: str, name: str) -> Path:
    """Find the file of a robot or scene.

    Args:
        kind: "robots" or "scenes".
        name: A shipped file's name without .xml, or the path of an .xml file.

    Raises:
        BadInputError: If the file does not exist; the message lists the shipped ones.
    """
    path = Path(name) if name.endswith(".xml") else FOLDER / kind / f"{name}.xml"
    if not path.is_file():
        shipped = ", ".join(sorted(file.stem for file in (FOLDER / kind).glob("*.xml")))
        raise BadInputError(f"no {kind[:-1]} named {name!r}; available: {shipped}, or an .xml file")
    return path


def compile_model(robot: str, scene: str) -> Any:
    """Attach the robot to the scene's frame `spawn` and compile both.

    Static bodies are fused, which halves the time of a step but loses the names of the bodies.
    Therefore each geom of the scene gets the name BODY/NUMBER, by which a contact finds its body.

    Args:
        robot: Name or path of the robot's file.
        scene: Name or path of the scene's file.

    Returns:
        An `MjModel`; the robot's names begin with `robot/`.

    Raises:
        BadInputError: If a file is missing, cannot be read or does not compile.
    """
    robot_path, scene_path = model_path("robots", robot), model_path("scenes", scene)
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
        spec.compiler.fusestatic = True
        model = spec.compile()
    except (ValueError, KeyError) as error:
        reason = " ".join(str(error).split())
        raise BadInputError(f"{robot_path} in {scene_path} does not compile: {reason}") from None
    _check(model, robot_path, scene_path)
    return model


def _check(model: Any, robot_path: Path, scene_path: Path) -> None:
    """Check that robot and scene have what the loop needs."""
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
    differs = [what for what in _facts(model) if not what.fits]
    if differs:
        found = "; ".join(
            f"{what.name} is {what.found:.4g}, not {what.wanted}" for what in differs[:SHOWN]
        )
        found += f"; and {len(differs) - SHOWN} more" * (len(differs) > SHOWN)
        where = (
            scene_path if all(what.name == "gravity [m/s^2]" for what in differs) else robot_path
        )
        raise BadInputError(f"{where}: the onboard controller is not made for it: {found}")


class _Fact(NamedTuple):
    """A number of a model that the onboard controller relies on.

    Attributes:
        name: Name of the number, with the unit.
        found: Value in the model.
        wanted: Values for which the controller is made, in words.
        fits: Whether the value is near enough.
    """

    name: str
    found: float
    wanted: str
    fits: bool


def _near(name: str, found: float, wanted: float, tolerance: float) -> _Fact:
    """Compare a value of the model with the value that the controller assumes."""
    words = f"{wanted:g} +- {tolerance:.2g}"
    return _Fact(name, found, words, abs(found - wanted) <= tolerance)


def _facts(model: Any) -> Iterator[_Fact]:
    """Compare a model with what the onboard controller and the rotors assume.

    The tolerances of mass and inertia: the velocity loop compensates for a weight that differs by
    1 N, and the attitude gains work for an inertia that differs by half.
    """
    base = model.jnt_bodyid[0]
    yield _near("mass [kg]", model.body_mass[base], MASS, 0.1 * MASS)
    yield _near("gravity [m/s^2]", -model.opt.gravity[2], GRAVITY, 0.02 * GRAVITY)
    for axis, offset, most in zip("xyz", model.body_ipos[base], (0.01, 0.01, 0.03), strict=True):
        yield _near(f"centre of mass, {axis} [m]", offset, 0.0, most)
    axes = np.empty(9)
    mujoco.mju_quat2Mat(axes, model.body_iquat[base])
    turned = axes.reshape(3, 3)
    inertia = np.diag(turned @ np.diag(model.body_inertia[base]) @ turned.T)
    for axis, found, wanted in zip("xyz", inertia, INERTIA, strict=True):
        yield _near(f"inertia about {axis} [kg m^2]", found, wanted, 0.5 * wanted)
    yield _Fact("damping of the base", max(model.dof_damping), "0", not model.dof_damping.any())
    tip = model.site(f"{ROBOT_PREFIX}tip").pos
    for axis, found, wanted in zip("xyz", tip, TIP, strict=True):
        yield _near(f"tip, {axis} [m]", found, wanted, 0.01)
    places = ((ARM, 0.0), (0.0, ARM), (-ARM, 0.0), (0.0, -ARM))
    for number, (x, y) in enumerate(places):
        yield from _rotor_facts(model, number, (x, y, HEIGHT), 1 if x else -1)


def _rotor_facts(
    model: Any, number: int, place: tuple[float, float, float], sign: int
) -> Iterator[_Fact]:
    """Compare one actuator with the rotor at `place` [m], body frame.

    `sign` is the sign of the rotor's reaction torque about z.
    """
    name = ROTORS[number]
    if model.actuator_trntype[number] != mujoco.mjtTrn.mjTRN_SITE:
        yield _Fact(f"{name} transmission", model.actuator_trntype[number], "a site", False)
        return
    site = model.actuator_trnid[number, 0]
    for axis, found, wanted in zip("xyz", model.site_pos[site], place, strict=True):
        yield _near(f"{name} place, {axis} [m]", found, wanted, 0.01)
    axes = np.empty(9)
    mujoco.mju_quat2Mat(axes, model.site_quat[site])
    gear = model.actuator_gear[number]
    thrust, torque = axes.reshape(3, 3) @ gear[:3], axes.reshape(3, 3) @ gear[3:]
    for axis, found, wanted in zip("xyz", thrust, (0.0, 0.0, 1.0), strict=True):
        yield _near(f"{name} gear, thrust along {axis}", found, wanted, 0.01)
    for axis, found, wanted in zip("xyz", torque, (0.0, 0.0, sign * TORQUE_RATIO), strict=True):
        yield _near(f"{name} gear, torque about {axis} [m]", found, wanted, 0.001)
    yield _near(f"{name} gain", model.actuator_gainprm[number, 0], 1.0, 0.01)
    for kind in ("bias", "dyn"):
        found = getattr(model, f"actuator_{kind}type")[number]
        yield _Fact(f"{name} {kind}type", found, "0 (none)", found == 0)
    for kind in ("ctrl", "force"):
        low, high = getattr(model, f"actuator_{kind}range")[number]
        free = not getattr(model, f"actuator_{kind}limited")[number]
        wide = f"at least {THRUST_MAX:.3g}, the largest thrust"
        yield _Fact(f"{name} {kind}range, end [N]", high, wide, free or high >= THRUST_MAX)
        yield _Fact(f"{name} {kind}range, begin [N]", low, "0 or less", free or low <= 0.0)
