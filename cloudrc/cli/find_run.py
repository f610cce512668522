"""Which run on this machine a command means: flags come in, its API or its link goes out.

Where a run is written: a folder of its own, which nothing later overwrites.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import socket
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from cloudrc.cli.output import say
from cloudrc.errors import BadInputError, MissingPrerequisiteError

_Found = TypeVar("_Found")
KUBECTL_PLUGIN = "kubectl-cloudrc"
"""What this program is called when kubectl starts it."""
CONNECT_LIMIT = 1.0
"""For the API of a run on this machine to take a connection [s]."""
QUIET_LIMIT = 5.0
"""A relay that has written nothing for so long is gone, if its run is not announced [s]."""


def run_argument(parser: argparse.ArgumentParser) -> None:
    """Declare the flag."""
    parser.add_argument("--run", type=Path, metavar="DIR", help="folder of a run that flies here")


def find_here(
    options: argparse.Namespace, there: Callable[[Path], _Found | None], nobody: str
) -> _Found | None:
    """Find what a command wants of the run that flies here, unless a cluster is meant.

    That of ./runs/latest comes first, then the only other one of this user, wherever it was
    started.

    Args:
        options: With `run_argument` and `cluster_flags.place_arguments`.
        there: Finds it in the folder of a run; None if none flies there.
        nobody: What to say of a folder that was named, if so.

    Raises:
        BadInputError: If there are several others, or none where the flag says.
    """
    in_cluster = options.context or options.namespace or options.release
    if options.run is not None:
        if in_cluster:
            raise BadInputError("--run names a run here, the other flags a cluster; give one")
        if (found := there(options.run)) is None:
            raise BadInputError(f"--run {options.run}: {nobody}")
        return found
    if in_cluster or Path(sys.argv[0]).name.startswith(KUBECTL_PLUGIN):
        return None
    from cloudrc.drivers.local import under_way

    if (found := there(RUNS / "latest")) is not None:
        return found
    others = [(run, found) for run in under_way() if (found := there(run)) is not None]
    if len(others) > 1:
        names = " or ".join(f"--run {run}" for run, _ in others)
        raise BadInputError(f"{len(others)} runs fly here; say which: {names}")
    if not others:
        return None
    ((run, found),) = others
    say(f"cloudrc: the run that flies in {run}", sys.stderr)
    return found


def nobody_here(
    options: argparse.Namespace, error: MissingPrerequisiteError, flags: str
) -> MissingPrerequisiteError:
    """Say beside what a cluster lacks, unless the flags name one, that a run here would do.

    Args:
        options: As of `find_here`.
        error: What it lacks.
        flags: Which would have named a run here.
    """
    if options.context or options.namespace:
        return error
    return MissingPrerequisiteError(
        f"no run flies here (start one: cloudrc run; or name one: {flags}), and {error}"
    )


def link_of(run: Path) -> Path | None:
    """Find where the relay of the run in this folder is told to change; None if none flies there.

    A run that was killed leaves that behind, too.
    """
    from cloudrc.drivers.local import LINK_FOLDER, under_way

    folder = run / LINK_FOLDER
    try:
        quiet = time.time() - folder.stat().st_mtime
    except OSError:
        return None
    return folder if run.resolve() in under_way() or quiet < QUIET_LIMIT else None


def url_of(run: Path) -> str | None:
    """Find where the API of this user's run in this folder is; None if none flies there.

    What the folder says of that is not believed: the operator's word goes to no server that
    somebody else has named.
    """
    from cloudrc.drivers.local import under_way

    url = under_way().get(Path(os.path.realpath(run)), "")
    return url if url and not _is_gone(url) else None


def _is_gone(url: str) -> bool:
    """Say whether nobody listens: a run is announced before its API is there."""
    from cloudrc.cli.client import UNIX

    try:
        with socket.socket(socket.AF_UNIX) as listening:
            listening.settimeout(CONNECT_LIMIT)
            listening.connect(url.removeprefix(UNIX))
    except (ConnectionRefusedError, FileNotFoundError):
        return True
    except OSError:
        return False  # whatever it is, the verb itself says it better
    return False


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
