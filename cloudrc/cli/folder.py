"""Where a run is written: a folder of its own, which nothing later overwrites."""

from __future__ import annotations

import contextlib
from pathlib import Path

from cloudrc.errors import BadInputError

RUNS = Path("runs")


def new_folder(out: Path | None, name: str, *, latest: bool = True) -> Path:
    """Make the folder of a run.

    Args:
        out: As the user asked; None for the next free `runs/<name>-<n>`.
        name: Experiment, mode and seed in one word.
        latest: Whether `runs/latest` leads to it from now on.

    Raises:
        BadInputError: If `out` exists and is not an empty folder, or if it cannot be made.
    """
    try:
        folder = _new_folder(out, name)
    except OSError as error:
        where = f"--out {out}" if out else f"{RUNS}/ in the working folder"
        remedy = "name another folder" if out else "name a folder that you may write in with --out"
        raise BadInputError(f"{where}: cannot be made: {error.strerror}; {remedy}") from error
    if latest and out is None:
        point_latest_to(folder)
    return folder


def discard(folder: Path) -> bool:
    """Remove the folder of a run that has recorded nothing; say whether it is gone."""
    if any(path.stat().st_size for path in folder.glob("*.mcap")):
        return False
    for path in (*folder.glob("*.mcap"), folder / "config.yaml"):
        path.unlink(missing_ok=True)
    with contextlib.suppress(OSError):  # there is something else in it
        folder.rmdir()
    return not folder.exists()


def _new_folder(out: Path | None, name: str) -> Path:
    if out is not None:
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise BadInputError(
                f"--out {out}: it is there already; name a new folder, runs are never overwritten"
            )
        out.mkdir(parents=True, exist_ok=True)
        return out
    RUNS.mkdir(exist_ok=True)
    n = 1
    while True:
        folder = RUNS / f"{name}-{n}"
        try:
            folder.mkdir()  # fails if another process takes the same number at the same time
        except FileExistsError:
            n += 1
            continue
        return folder


def point_latest_to(folder: Path) -> None:
    """Let `runs/latest` lead to the newest run; a file system without links goes without."""
    latest = folder.parent / "latest"
    with contextlib.suppress(OSError):
        if latest.is_symlink():
            latest.unlink()
        latest.symlink_to(folder.name, target_is_directory=True)
