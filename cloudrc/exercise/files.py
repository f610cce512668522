"""The files of a task in a student's folder."""

from __future__ import annotations

from collections.abc import Collection
from difflib import get_close_matches
from pathlib import Path

from cloudrc.config.task import read_task
from cloudrc.files import write_atomically
from cloudrc.outside.paths import check_new, check_there

SHIPPED = Path(__file__).with_name("task.yaml")
"""The exercise of docs/exercise.md."""
COPY = "task.yaml"
"""Name of a task in a student's folder."""


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


def describe_missing(folder: Path, names: Collection[str]) -> str:
    """Say which files in a folder look like those of the `names` that it lacks; "" if none does."""
    lacks = [name for name in names if not (folder / name).exists()]
    others = {path.name.lower(): path.name for path in folder.iterdir() if path.name not in names}
    found = list[str]()
    for name in lacks:
        for near in get_close_matches(name.lower(), others, n=1, cutoff=0.7):
            found.append(f"there is '{others[near]}': rename it to {name}")
    return "; ".join(found)
