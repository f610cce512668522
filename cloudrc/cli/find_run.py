"""Find the run on this machine that a command refers to, and make folders for new runs.

Every run has its own folder; no later run overwrites it.
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

from cloudrc.cli.output import print_line
from cloudrc.errors import BadInputError, MissingPrerequisiteError

_Found = TypeVar("_Found")
KUBECTL_PLUGIN = "kubectl-cloudrc"
"""Name of this program when kubectl starts it as a plugin."""
CONNECT_LIMIT = 1.0
"""Time limit for the API of a local run to accept a connection [s]."""
QUIET_LIMIT = 5.0
"""Longest silence of a relay whose run is not listed as under way [s]. After a longer time without
a write to its folder, the relay counts as gone."""


def run_argument(parser: argparse.ArgumentParser) -> None:
    """Declare `--run`."""
    parser.add_argument(
        "--run", type=Path, metavar="DIR", help="folder of a run that is flying on this machine"
    )


def find_local_run(
    options: argparse.Namespace, look: Callable[[Path], _Found | None], nobody: str
) -> _Found | None:
    """Find the API or the link of the run that is flying on this machine.

    Do nothing if the flags name a cluster.

    First choice is the run in ./runs/latest. Second choice is this user's only other run, whatever
    folder it was started in.

    Args:
        options: The parsed flags of `run_argument` and of `cluster_flags`.
        look: Returns the API or the link of the run in a folder; None if no run is flying there.
        nobody: Error text if no run is flying in the folder of `--run`.

    Returns:
        The result of `look`; None if the flags name a cluster, or if no run is flying.

    Raises:
        BadInputError: If `--run` is given and no run is flying in its folder, if `--run` is given
            together with flags of a cluster, or if `--run` is not given and several runs are
            flying.
    """
    in_cluster = options.context or options.namespace or options.release
    if options.run is not None:
        if in_cluster:
            raise BadInputError("--run names a run here, the other flags a cluster; give one")
        if (found := look(options.run)) is None:
            raise BadInputError(f"--run {options.run}: {nobody}")
        return found
    if in_cluster or Path(sys.argv[0]).name.startswith(KUBECTL_PLUGIN):
        return None
    from cloudrc.drivers.local import under_way

    if (found := look(RUNS / "latest")) is not None:
        return found
    others = [(run, found) for run in under_way() if (found := look(run)) is not None]
    if len(others) > 1:
        names = " or ".join(f"--run {run}" for run, _ in others)
        raise BadInputError(f"{len(others)} runs are flying here; choose one: {names}")
    if not others:
        return None
    ((run, found),) = others
    print_line(f"cloudrc: using the run in {run}", sys.stderr)
    return found


def no_run_error(
    options: argparse.Namespace, error: MissingPrerequisiteError, flags: str
) -> MissingPrerequisiteError:
    """Add to a cluster's error that no run is flying on this machine either.

    Args:
        options: As in `find_local_run`. If they name a context or a namespace, the error is
            returned unchanged.
        error: The cluster's error.
        flags: The flags that name a local run, for the text.
    """
    if options.context or options.namespace:
        return error
    return MissingPrerequisiteError(
        f"no run flies here (start one: cloudrc run; or name one: {flags}), and {error}"
    )


def link_folder_of(run: Path) -> Path | None:
    """Return the folder that controls the relay of a run; None if the run is not flying.

    The folder alone does not prove a flight, because a killed run leaves the folder behind.
    """
    from cloudrc.drivers.local import LINK_FOLDER, under_way

    folder = run / LINK_FOLDER
    try:
        quiet_time = time.time() - folder.stat().st_mtime
    except OSError:
        return None
    return folder if run.resolve() in under_way() or quiet_time < QUIET_LIMIT else None


def api_url_of(run: Path) -> str | None:
    """Return the URL of the API of this user's run in a folder; None if the run is not flying.

    The URL comes from this user's runtime folder, never from the run's folder: a run's folder may
    come from somebody else and name a foreign server.
    """
    from cloudrc.drivers.local import under_way

    url = under_way().get(Path(os.path.realpath(run)), "")
    return url if url and not _is_gone(url) else None


def _is_gone(url: str) -> bool:
    """Return True if no API listens at a URL: a run is announced before its API is up."""
    from cloudrc.cli.client import UNIX

    try:
        with socket.socket(socket.AF_UNIX) as listening:
            listening.settimeout(CONNECT_LIMIT)
            listening.connect(url.removeprefix(UNIX))
    except (ConnectionRefusedError, FileNotFoundError):
        return True
    except OSError:
        return False  # the command itself reports it better
    return False


RUNS = Path("runs")


def new_folder(out: Path | None, name: str, *, latest: bool = True) -> Path:
    """Make the folder of a run.

    Args:
        out: The folder that the user wants; None for the next free `runs/<name>-<n>`.
        name: Experiment, mode and seed, joined.
        latest: Whether `runs/latest` points to the new folder from now on.

    Raises:
        BadInputError: If `out` exists and is not an empty folder, or if the folder cannot be made.
    """
    try:
        folder = _new_folder(out, name)
    except OSError as error:
        where = f"--out {out}" if out else f"{RUNS}/ in the working folder"
        remedy = "name another folder" if out else "name a writable folder with --out"
        raise BadInputError(f"{where}: cannot be made: {error.strerror}; {remedy}") from error
    if latest and out is None:
        point_latest_to(folder)
    return folder


def discard(folder: Path) -> bool:
    """Remove the folder of a run that has recorded nothing; return whether it is removed."""
    if any(path.stat().st_size for path in folder.glob("*.mcap")):
        return False
    for path in (*folder.glob("*.mcap"), folder / "config.yaml"):
        path.unlink(missing_ok=True)
    with contextlib.suppress(OSError):  # it contains other files
        folder.rmdir()
    return not folder.exists()


def _new_folder(out: Path | None, name: str) -> Path:
    if out is not None:
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise BadInputError(
                f"--out {out}: already exists; name a new folder, runs are never overwritten"
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
    """Point `runs/latest` to the newest run, if the file system supports symbolic links."""
    latest = folder.parent / "latest"
    with contextlib.suppress(OSError):
        if latest.is_symlink():
            latest.unlink()
        latest.symlink_to(folder.name, target_is_directory=True)
