"""Where configuration files are: a name or a path goes in, the file's document comes out."""

from __future__ import annotations

import os
from pathlib import Path

from cloudrc.config import document
from cloudrc.config.document import Document
from cloudrc.errors import BadInputError
from cloudrc.plugins import meant, unknown

_PACKAGE = Path(__file__).parents[1]
FOLDERS = {
    "experiment": _PACKAGE / "experiments",
    "mission": _PACKAGE / "missions",
    "profile": _PACKAGE / "link" / "profiles",
    "scene": _PACKAGE / "world" / "scenes",
    "robot": _PACKAGE / "world" / "robots",
}
"""Kind of file -> where those lie that ship."""


def names(kind: str) -> list[str]:
    """List the shipped files of a kind by their configuration names, sorted."""
    return sorted(path.stem for path in FOLDERS[kind].iterdir() if path.suffix in (".yaml", ".xml"))


def describe(kind: str, name: str) -> str:
    """Give the first line of a shipped YAML file's `description`."""
    text = read(kind, name, Path()).tree.get("description", "")
    return str(text).strip().partition("\n")[0]


def read(kind: str, name: str, folder: Path) -> Document:
    """Read a YAML file by its name or path.

    Args:
        kind: "experiment", "mission" or "profile".
        name: Of a shipped file; or a path, if there is a slash or `.yaml` in it.
        folder: What a relative path is relative to.

    Raises:
        BadInputError: If there is no such file, or it cannot be read.
    """
    if is_path(name):
        path = folder / os.path.expanduser(name)
        if not os.path.exists(path):  # which says no to a name that no file can have
            raise BadInputError(f"no such file: {path}; {_shipped_instead(kind, path.stem)}")
        return document.read(path, name)
    check_name(kind, name)
    return document.read(FOLDERS[kind] / f"{name}.yaml", f"{name}.yaml")


def check_name(kind: str, name: str) -> None:
    """Raise a BadInputError if no file of this kind ships under that name."""
    available = names(kind)
    if name not in available:
        raise BadInputError(unknown(kind, name, available))


def _shipped_instead(kind: str, name: str) -> str:
    """Say how the shipped files are named, to one who gave a path that leads nowhere."""
    available = names(kind)
    there = ", ".join(available)
    return f"shipped {kind}s go by their names: {there}{meant(name, available)}"


def is_path(name: str) -> bool:
    """Say whether a name means a file outside the package."""
    return "/" in name or "\\" in name or name.endswith((".yaml", ".yml"))
