"""Find configuration files by name or path, and read them."""

from __future__ import annotations

import os
from pathlib import Path

from cloudrc.config import document
from cloudrc.config.document import Document
from cloudrc.errors import BadInputError
from cloudrc.plugins import suggest_name, unknown_name_text

_PACKAGE = Path(__file__).parents[1]
FOLDERS = {
    "experiment": _PACKAGE / "experiments",
    "mission": _PACKAGE / "missions",
    "profile": _PACKAGE / "link" / "profiles",
    "scene": _PACKAGE / "world" / "scenes",
    "robot": _PACKAGE / "world" / "robots",
}
"""Kind of file -> folder of the shipped files."""


def names(kind: str) -> list[str]:
    """List the shipped files of a kind by their configuration names, sorted."""
    return sorted(path.stem for path in FOLDERS[kind].iterdir() if path.suffix in (".yaml", ".xml"))


def describe(kind: str, name: str) -> str:
    """Return the first line of a shipped YAML file's `description`."""
    text = read(kind, name, Path()).tree.get("description", "")
    return str(text).strip().partition("\n")[0]


def read(kind: str, name: str, folder: Path) -> Document:
    """Read a YAML file by its name or path.

    Args:
        kind: "experiment", "mission" or "profile".
        name: Name of a shipped file, or a path. A path contains a slash or ends with `.yaml`.
        folder: Folder at which a relative path starts.

    Raises:
        BadInputError: If there is no such file, or the file cannot be read.
    """
    if is_path(name):
        path = folder / os.path.expanduser(name)
        if not os.path.exists(path):  # False, not an exception, for an impossible name
            raise BadInputError(f"no such file: {path}; {_shipped_names(kind, path.stem)}")
        return document.read_document(path, name)
    check_name(kind, name)
    return document.read_document(FOLDERS[kind] / f"{name}.yaml", f"{name}.yaml")


def check_name(kind: str, name: str) -> None:
    """Raise a BadInputError if no shipped file of this kind has that name."""
    available = names(kind)
    if name not in available:
        raise BadInputError(unknown_name_text(kind, name, available))


def _shipped_names(kind: str, name: str) -> str:
    """Return a text that lists the shipped files and suggests the name most similar to `name`."""
    available = names(kind)
    return f"names of shipped {kind}s: {', '.join(available)}{suggest_name(name, available)}"


def model_path(kind: str, name: str, folder: Path) -> str:
    """Return the name of a shipped robot or scene, or the absolute path of an .xml file.

    Args:
        kind: "robot" or "scene".
        name: As in an experiment.
        folder: Folder at which a relative path starts.

    Raises:
        BadInputError: If there is no such file.
    """
    if not (is_path(name) or name.endswith(".xml")):
        check_name(kind, name)
        return name
    path = os.path.realpath(folder / os.path.expanduser(name))
    if not path.endswith(".xml") or not os.path.isfile(path):
        reason = "no such file" if path.endswith(".xml") else "not an .xml file"
        raise BadInputError(f"{reason}: {path}; {_shipped_names(kind, Path(path).stem)}")
    return path


def is_path(name: str) -> bool:
    """Whether a name is the path of a file outside the package."""
    return "/" in name or "\\" in name or name.endswith((".yaml", ".yml"))
