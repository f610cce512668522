# SPDX-License-Identifier: Apache-2.0

"""Find and read configuration files: shipped files by name, other files by path."""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path

from cloudrc.base.errors import BadInputError
from cloudrc.base.outside.document import Document, read_document
from cloudrc.base.text import unknown_name_text

_CONFIG = Path(__file__).parent
_PACKAGE = _CONFIG.parent
FOLDERS = {
    "experiment": _CONFIG / "experiments",
    "mission": _CONFIG / "missions",
    "place": _CONFIG / "places",
    "profile": _PACKAGE / "link" / "profiles",
    "scene": _PACKAGE / "world" / "scenes",
    "robot": _PACKAGE / "robots",
}
"""Kind of file -> folder of the shipped files; each robot has a folder of its own in it."""
ROBOT_FILE = "robot.yaml"
"""Name of the file that describes a robot, in its folder."""


@cache
def names(kind: str) -> list[str]:
    """List the names of the shipped files of a kind, such as "profile", in alphabetical order."""
    folder = FOLDERS[kind]
    if kind == "robot":
        return sorted(path.parent.name for path in folder.glob(f"*/{ROBOT_FILE}"))
    return sorted(path.stem for path in folder.iterdir() if path.suffix in (".yaml", ".xml"))


def file_of(scene: str) -> Path:
    """Return the MJCF file of a scene, given by its name or by the path of the file."""
    return Path(scene) if scene.endswith(".xml") else FOLDERS["scene"] / f"{scene}.xml"


def describe(kind: str, name: str) -> str:
    """Return the first line of a shipped YAML file's `description`."""
    path = FOLDERS[kind] / (f"{name}/{ROBOT_FILE}" if kind == "robot" else f"{name}.yaml")
    text = read_document(path, path.name).tree.get("description", "")
    return str(text).strip().partition("\n")[0]


def read(kind: str, name: str, folder: Path) -> Document:
    """Read an experiment, mission, place or profile by name, or by path relative to `folder`.

    Raise a BadInputError if this is not possible.
    """
    if is_path(name):
        return read_document(folder / os.path.expanduser(name), name)
    check_name(kind, name)
    return read_document(FOLDERS[kind] / f"{name}.yaml", f"{name}.yaml")


def check_name(kind: str, name: str) -> None:
    """Raise a BadInputError if no shipped file of this kind has that name."""
    if name not in names(kind):
        text = unknown_name_text(kind, name, names(kind))
        raise BadInputError(f"{text}; for one of your own, give its path, such as ./{name}")


def model_path(kind: str, name: str, folder: Path) -> str:
    """Return the name of a shipped robot or scene, or the absolute path of an .xml file.

    A robot may also be a folder with the file `robot.yaml`. `kind` is "robot" or "scene". Raise a
    BadInputError if the name or the file does not exist.
    """
    if not (is_path(name) or name.endswith(".xml")):
        check_name(kind, name)
        return name
    path = Path(os.path.realpath(folder / os.path.expanduser(name)))
    is_robot = kind == "robot" and os.path.isfile(path / ROBOT_FILE)
    if not is_robot and not (path.suffix == ".xml" and os.path.isfile(path)):
        what = f"folder with {ROBOT_FILE} or .xml file" if kind == "robot" else ".xml file"
        raise BadInputError(f"no such {what}: {path}")
    return str(path)


def is_path(name: str) -> bool:
    """Whether `name` is the path of a file, not the name of a shipped file."""
    return "/" in name or "\\" in name or name.endswith((".yaml", ".yml"))
