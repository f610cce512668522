# SPDX-License-Identifier: Apache-2.0

"""The files of a task in a student's folder."""

from __future__ import annotations

from collections.abc import Collection
from difflib import get_close_matches
from itertools import islice
from pathlib import Path
from shlex import quote
from typing import NamedTuple
from zipfile import BadZipFile, ZipFile

from cloudrc.base.errors import BadInputError
from cloudrc.base.files import write_atomically
from cloudrc.base.outside.paths import check_new, check_there
from cloudrc.config.task import read_task

SHIPPED = Path(__file__).with_name("task.yaml")
"""The exercise of docs/exercise.md."""
COPY = "task.yaml"
"""Name of a task in a student's folder."""

ZIP_MAX = 200 << 20
"""Largest size of all files of a zip [bytes]."""
FILES_MAX = 1000
"""Largest number of files of a hand-in that are looked at."""


class HandIn(NamedTuple):
    """What a student has handed in."""

    name: str
    folder: Path
    """Where its files are"""
    source: Path
    """The task"""
    unreadable: str = ""
    """Why it cannot be read"""


def task_of(folder: Path, given: Path | None = None) -> Path:
    """Return the path of a hand-in's task: the given one, the copy in its folder, the exercise."""
    copy = folder / COPY
    return given or (copy if copy.is_file() else SHIPPED)


def write_files(folder: Path, source: Path = SHIPPED, needed: Collection[Path] = ()) -> list[str]:
    """Write the files that students fill in, none of which may exist; return their names.

    The files lie beside the task `source`. That of a lecturer is copied, too, with the files that
    its flights need.
    """
    names = [*read_task(source).files.values()]
    beside = source.resolve().parent
    given = {str(path.relative_to(beside)): path for path in sorted(needed)}
    given |= {name: source.with_name(name) for name in names}
    if source != SHIPPED:
        given[COPY] = source
    for name, path in given.items():
        check_there(path, f"{source} names it; write it as students shall get it")
        check_new(folder / name, "name another folder")
    for name, path in given.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        write_atomically(folder / name, path.read_bytes())
    return names


def open_hand_in(given: Path, task: Path | None, scratch: Path) -> HandIn:
    """Find the files of a hand-in: in a folder or a zip, in a folder or a zip in it.

    `task` is the given task, None: that of the hand-in. Zips are unpacked into the new folder
    `scratch`.
    """
    folder = given
    try:
        if given.is_file():
            folder = _unpack(given, scratch)
        found = _with_files(folder, task)
        zips = [] if found else [path for path in _files_below(folder) if path.suffix == ".zip"]
        if len(zips) == 1:
            found = _with_files(folder := _unpack(zips[0], scratch / "inner"), task)
        place = found[0] if len(found) == 1 else folder
        source = task_of(place, task)
        read_task(source)
    except BadInputError as error:
        return HandIn(given.name, folder, task or SHIPPED, str(error).replace(f"{scratch}", ""))
    return HandIn(given.name, place.resolve(), source.resolve())


def _unpack(path: Path, folder: Path) -> Path:
    try:
        with ZipFile(path) as file:
            if sum(each.file_size for each in file.infolist()) > ZIP_MAX:
                raise BadInputError(f"{path.name}: more than {ZIP_MAX >> 20} MiB; hand in less")
            file.extractall(folder)
    except (BadZipFile, OSError, RuntimeError, ValueError) as error:
        raise BadInputError(f"{path.name}: no zip that can be read ({error})") from None
    return folder


def _files_below(folder: Path) -> list[Path]:
    """Return the files in a folder and below, without those that a Mac adds to a zip."""
    found = (path for path in folder.rglob("*") if path.is_file())
    inside = ((path, path.relative_to(folder).parts) for path in found)
    seen = (p for p, parts in inside if not any(x[0] == "." or x == "__MACOSX" for x in parts))
    return sorted(islice(seen, FILES_MAX))


def _with_files(folder: Path, task: Path | None) -> list[Path]:
    """Return the folder if it has files of the task, else the folders below that have some."""
    folders = dict.fromkeys([folder, *(path.parent for path in _files_below(folder))])
    found = []
    for each in folders:
        source = task_of(each, task)
        names = read_task(source).files.values()
        if source.parent == each or any((each / name).is_file() for name in names):
            found.append(each)
    return [folder] if folder in found else found


def describe_missing(folder: Path, names: Collection[str]) -> str:
    """Say which of the files `names` a folder lacks, and what to do; "" if it has all.

    A notebook with the name of a Python file counts as missing.
    """
    files = _files_below(folder)
    others = {path.name.lower(): path for path in files if path.name not in names}
    found = list[str]()
    for name in names:
        path, stem = folder / name, Path(name).stem
        if path.is_file() and not _is_notebook(path):
            continue
        near = get_close_matches(name.lower(), others, n=1, cutoff=0.7)
        # A notebook with the name of another part is no candidate for this one.
        stems = {Path(other).stem for other in names} - {stem}
        notebooks = [each for each in files if each.suffix == ".ipynb" and each.stem not in stems]
        twins = [str(other.relative_to(folder)) for other in files if other.name == name]
        if path.is_file():
            command = f"jupyter nbconvert --to script {stem}.ipynb"
            text = f"is a notebook, not Python: rename it to {stem}.ipynb, then {command}"
        elif twins:
            text = f"is missing here; there is {' and '.join(twins)}: put all files into one folder"
        elif near and others[near[0]].suffix != ".ipynb":
            text = f"is missing; there is '{others[near[0]].name}': rename it to {name}"
        elif notebooks:
            fits = [each for each in notebooks if near and each == others[near[0]]]
            other = str((fits or notebooks)[0].relative_to(folder))
            command = f"jupyter nbconvert --to script {quote(other)} --output {stem}"
            text = f"is missing; there is the notebook '{other}': {command}"
        else:
            text = "is missing"
        found.append(f"{name} {text}")
    return "; ".join(found)


def _is_notebook(path: Path) -> bool:
    content = path.read_bytes()
    return content.lstrip()[:1] == b"{" and b'"nbformat"' in content
