"""Compile a robot and a scene into one MuJoCo model.

No other module of `world` imports the package `mujoco`; they take it from here.
"""

from __future__ import annotations

import logging
import os
import sys
from pathlib import Path
from typing import Any

from cloudrc.errors import BadInputError, MissingPrerequisiteError

ROBOT_PREFIX = "robot/"
"""Prefix of all names that belong to the robot in a compiled model."""
ROTORS = ("rotor_front", "rotor_left", "rotor_back", "rotor_right")
"""Names of a robot's actuators. Every tuple of four rotor values has the same order."""
TIMESTEP = 0.002
"""Step of the physics and of the onboard part [s].
Source: docs/reference/plant.md, "Physics step"."""
FOLDER = Path(__file__).parent
_NO_GL = {"", "disable", "disabled", "off", "false", "0"}


def import_mujoco() -> Any:
    """Import MuJoCo without OpenGL, which a flight does not need.

    With MUJOCO_GL=egl and no libEGL, `import mujoco` fails. Therefore the variable is `disable`
    during the import. It is restored afterwards, for a child process that renders.

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

    Static bodies are fused, which halves the time of a step. Their names are lost by that, so each
    geom of the scene gets the name BODY/NUMBER, from which a contact finds its body.

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
