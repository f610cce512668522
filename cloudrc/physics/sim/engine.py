# SPDX-License-Identifier: Apache-2.0

"""Import MuJoCo, and turn its errors into those of cloudrc."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from cloudrc.base.errors import (
    MissingPrerequisiteError,
    OutOfMemoryError,
    tells_no_memory,
)
from cloudrc.base.outside.values import InvalidValueError


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
# Otherwise MuJoCo writes its warnings to MUJOCO_LOG.TXT in the working directory.
mujoco.set_mju_user_warning(logging.getLogger("mujoco").warning)


GEOM, JOINT, TRANSMISSION = mujoco.mjtGeom, mujoco.mjtJoint, mujoco.mjtTrn
"""Numbers of the types of geoms, of joints, and of what an actuator acts on."""


def at_rest(model: Any) -> Any:
    """Return the `MjData` of a compiled `MjModel` whose joints are at rest."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data


def place_cameras(model: Any, data: Any) -> None:
    """Compute where bodies and cameras are at the positions of the joints in `data`."""
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_camlight(model, data)


@contextmanager
def compiling(what: object) -> Iterator[None]:
    """Turn an error of MuJoCo in the block, which compiles `what`, into an InvalidValueError.

    MuJoCo reports a lack of memory as an error of the file. It says nothing about the file.
    """
    try:
        yield
    except (ValueError, KeyError) as error:
        reason = " ".join(str(error).split())
        if tells_no_memory(reason):
            text = f"memory ran out: {what} could not be compiled"
            raise OutOfMemoryError(f"{text}; use fewer processes, or free some memory") from None
        raise InvalidValueError(f"{what} does not compile: {reason}") from None


def compile_alone(file: Path) -> Any:
    """Compile an MJCF file by itself; raise an InvalidValueError if it does not compile."""
    with compiling(file):
        return mujoco.MjSpec.from_file(str(file)).compile()
