"""Find and read configuration files: shipped files by name, other files by path."""

from __future__ import annotations

import os
from pathlib import Path

from cloudrc.errors import BadInputError
from cloudrc.outside.document import Document, read_document
from cloudrc.outside.reuse import reuse
from cloudrc.text import suggest_name, unknown_name_text

_PACKAGE = Path(__file__).parents[1]
FOLDERS = {
    "experiment": _PACKAGE / "experiments",
    "mission": _PACKAGE / "missions",
    "profile": _PACKAGE / "link" / "profiles",
    "scene": _PACKAGE / "world" / "scenes",
    "robot": _PACKAGE / "robots",
}
"""Kind of file -> folder of the shipped files; each robot has a folder of its own in it."""
ROBOT_FILE = "robot.yaml"
"""Name of the file that describes a robot, in its folder."""


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
    """Read an experiment, mission or profile by name, or by path relative to `folder`.

    Raise a BadInputError if this is not possible.
    """
    if not is_path(name):
        check_name(kind, name, folder)
        return read_document(FOLDERS[kind] / f"{name}.yaml", f"{name}.yaml")
    path = folder / os.path.expanduser(name)
    if not os.path.exists(path):  # unlike Path.exists, no exception for an invalid name
        raise _no_file("no such file", kind, path)
    return read_document(path, name)


def check_name(kind: str, name: str, folder: Path | None = None) -> None:
    """Raise a BadInputError if no shipped file of this kind has that name.

    The text suggests a file or folder of the user in `folder` with this name, if there is one.
    """
    if name not in (available := reuse(("names", kind), lambda: names(kind))):
        text = unknown_name_text(kind, name, available)
        if folder is not None and (own := _own_file(kind, name, folder)):
            text = f"no shipped {kind} named {name!r}; for your own, give its path: ./{own}"
        raise BadInputError(text)


def _own_file(kind: str, name: str, folder: Path) -> str:
    """Return the name of a file or folder of this kind in `folder`; "" if there is none."""
    endings = {"scene": [".xml"], "robot": ["", ".xml"]}.get(kind, [".yaml", ".yml"])
    for own in [f"{name}{ending}" for ending in endings]:
        path = folder / own
        found = path if own != name else path / ROBOT_FILE
        if os.path.isfile(found):
            return own
    return ""


def model_path(kind: str, name: str, folder: Path) -> str:
    """Return the name of a shipped robot or scene, or the absolute path of an .xml file.

    A robot may also be a folder with the file `robot.yaml`. `kind` is "robot" or "scene". Raise a
    BadInputError if the name or the file does not exist.
    """
    if not (is_path(name) or name.endswith(".xml")):
        check_name(kind, name, folder)
        return name
    path = Path(os.path.realpath(folder / os.path.expanduser(name)))
    if kind == "robot" and _is_robot_folder(path):
        return str(path)
    if path.suffix != ".xml" or not os.path.isfile(path):
        what = "folder or .xml file" if kind == "robot" else ".xml file"
        raise _no_file(f"no such {what}", kind, path)
    return str(path)


def _is_robot_folder(path: Path) -> bool:
    """Return whether `path` is a folder; raise a BadInputError if that folder is no robot."""
    if os.path.isdir(path):
        if not os.path.isfile(path / ROBOT_FILE):
            raise BadInputError(f"{path}: has no {ROBOT_FILE}, so it is no robot")
        return True
    if path.name == ROBOT_FILE and os.path.isfile(path):
        raise BadInputError(f"{path}: give its folder: {path.parent}")
    return False


def is_path(name: str) -> bool:
    """Whether `name` is the path of a file, not the name of a shipped file."""
    return "/" in name or "\\" in name or name.endswith((".yaml", ".yml"))


def _no_file(problem: str, kind: str, path: Path) -> BadInputError:
    available = names(kind)
    hint = f"names of shipped {kind}s: {', '.join(available)}{suggest_name(path.stem, available)}"
    return BadInputError(f"{problem}: {path}; {hint}")
