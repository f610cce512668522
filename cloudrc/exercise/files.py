"""The files of the exercise in a student's folder."""

from __future__ import annotations

from pathlib import Path

from cloudrc.errors import BadInputError
from cloudrc.files import write_atomically

FILES = {
    "estimator": "delay_estimator.py",
    "predictor": "predictor.py",
    "controller": "controller.py",
}
"""Part -> the student's file."""


def write_files(folder: Path) -> list[str]:
    """Write the files that students fill in; return their names.

    Raise a BadInputError if one of them exists: it stays as it is.
    """
    names = [*FILES.values()]
    if there := [name for name in names if (folder / name).exists()]:
        raise BadInputError(f"{folder / there[0]}: exists and stays as it is; name another folder")
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        write_atomically(folder / name, Path(__file__).with_name(name).read_bytes())
    return names


def check_folder(folder: Path, *, may_be_empty: bool = False) -> None:
    """Raise a BadInputError if a folder does not exist, is a file, or has none of the files.

    With `may_be_empty` it may have none, so that a hand-in without the files gets 0 points.
    """
    if folder.is_file():
        text = "is a file; if it is an archive, unpack it, and name the folder with the files"
        raise BadInputError(f"{folder}: {text}")
    if not folder.is_dir():
        raise BadInputError(f"{folder}: no such folder; 'cloudrc class new' makes one")
    names = FILES.values()
    if not may_be_empty and not any((folder / name).exists() for name in names):
        text = f"has none of {', '.join(names)}; name the folder that 'cloudrc class new' made"
        raise BadInputError(f"{folder}: {text}")
