"""Read what a robot is: its model, and the onboard controller that flies or drives it.

A robot is a folder with the file `robot.yaml`, or the file of a model alone. Shipped robots are the
folders in `cloudrc/robots/`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from cloudrc.config import shipped
from cloudrc.config.document import read_document
from cloudrc.config.problems import validate
from cloudrc.config.reuse import reuse
from cloudrc.config.schema import NameOr, PlugIn, Section
from cloudrc.plugins import is_path


class RobotFile(Section):
    """The file `robot.yaml`."""

    description: str = ""
    """One line about the robot, for lists"""
    model: str = "robot.xml"
    """MJCF file (.xml) of the robot, in the same folder or a path. Its base has a free joint"""
    onboard: NameOr[PlugIn]
    """Controller on board, which follows the velocity that the guard allows: the name of a plug-in,
    the path of a Python file, or a mapping with parameters"""
    planar: bool = False
    """Whether the robot stays on the ground. Then the guard limits x and y alone, HOLD and LAND
    brake the robot to rest, waypoints have the height of the spawn, and cloud commands no vertical
    velocity"""


@dataclass(frozen=True)
class RobotFiles:
    """A robot whose files are found."""

    model: Path  # MJCF file
    # With the absolute path of a Python file, or the name of a plug-in. None for a model alone:
    # which controller flies it depends on the model.
    onboard: PlugIn | None
    planar: bool = False  # whether it stays on the ground


def find_robot(name: str) -> RobotFiles:
    """Return the files of a robot, given by the name of a shipped robot, or by an absolute path.

    Raise a BadInputError if its `robot.yaml` is invalid.
    """
    if name.endswith(".xml"):
        return RobotFiles(Path(name), None)
    folder = Path(name) if shipped.is_path(name) else shipped.FOLDERS["robot"] / name
    file = folder / shipped.ROBOT_FILE
    label = str(file) if shipped.is_path(name) else f"{name}/{shipped.ROBOT_FILE}"
    robot = validate(read_document(file, label), RobotFile, label)
    onboard = robot.onboard if isinstance(robot.onboard, PlugIn) else PlugIn(name=robot.onboard)
    if is_path(onboard.name):
        onboard = onboard.model_copy(update={"name": str((folder / onboard.name).resolve())})
    return RobotFiles(folder / robot.model, onboard, robot.planar)


def is_planar(name: str) -> bool:
    """Return whether a robot stays on the ground; raise a BadInputError as `find_robot` does."""
    return reuse(("robot", name), lambda: find_robot(name)).planar


def files_of(name: str) -> list[Path]:
    """Return the files that the user's robot at a path consists of; [] for a shipped robot.

    The files that these files name are not in the list.
    """
    if not shipped.is_path(name) and not name.endswith(".xml"):
        return []
    if name.endswith(".xml"):
        return [Path(name)]
    robot = find_robot(name)
    own = [Path(robot.onboard.name)] if robot.onboard and is_path(robot.onboard.name) else []
    return [Path(name) / shipped.ROBOT_FILE, robot.model, *own]
