"""Find the run on this machine that a command refers to, and make folders for new runs."""

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
RUNS = Path("runs")
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
    """Find the API or the link of the run of `--run`, of ./runs/latest, or of the only other run.

    Args:
        options: The parsed flags of `run_argument` and of `cluster_flags`.
        look: Returns the API or the link of the run in a folder; None if no run is flying there.
        nobody: Error text if no run is flying in the folder of `--run`.

    Returns:
        The result of `look`; None if the flags name a cluster, or if no run is flying.

    Raises:
        BadInputError: If no run is flying in the folder of `--run`, if the flags also name a
            cluster, or if several runs are flying and none is named.
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
    others = {run: found for run in under_way() if (found := look(run)) is not None}
    if len(others) > 1:
        names = " or ".join(f"--run {run}" for run in others)
        raise BadInputError(f"{len(others)} runs are flying here; choose one: {names}")
    for run, found in others.items():
        print_line(f"cloudrc: using the run in {run}", sys.stderr)
        return found
    return None


def no_run_error(
    options: argparse.Namespace, error: MissingPrerequisiteError, flags: str
) -> MissingPrerequisiteError:
    """Add to a cluster's error that no run flies here either, unless the flags name a cluster.

    `flags` are those that name a local run, for the text.
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

    The URL comes from this user's flight files, never from the run's folder: a run's folder may
    come from somebody else and name a foreign server.
    """
    from cloudrc.cli.client import UNIX
    from cloudrc.drivers.local import under_way

    url = under_way().get(Path(os.path.realpath(run)))
    if not url:
        return None
    try:
        with socket.socket(socket.AF_UNIX) as probe:
            probe.settimeout(CONNECT_LIMIT)
            probe.connect(url.removeprefix(UNIX))
    except (ConnectionRefusedError, FileNotFoundError):  # announced before its API is up
        return None
    except OSError:
        pass  # the command itself reports it better
    return url


def new_folder(out: Path | None, name: str, *, latest: bool = True) -> Path:
    """Make the folder of a run; no later run overwrites it.

    Args:
        out: The folder that the user wants; None for the next free `runs/<name>-<n>`.
        name: Experiment, mode and seed, joined.
        latest: Whether `runs/latest` points to the new folder from now on.

    Raises:
        BadInputError: If `out` exists and is not an empty folder, or if the folder cannot be made.
    """
    try:
        folder = _next_folder(name) if out is None else _make(out)
    except OSError as error:
        where = f"--out {out}" if out else f"{RUNS}/ in the working folder"
        remedy = "name another folder" if out else "name a writable folder with --out"
        raise BadInputError(f"{where}: cannot be made: {error.strerror}; {remedy}") from error
    if latest and out is None:
        point_latest_to(folder)
    return folder


def _make(out: Path) -> Path:
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise BadInputError(
            f"--out {out}: already exists; name a new folder, runs are never overwritten"
        )
    out.mkdir(parents=True, exist_ok=True)
    return out


def _next_folder(name: str) -> Path:
    RUNS.mkdir(exist_ok=True)
    n = 1
    while True:
        with contextlib.suppress(FileExistsError):  # also if another process takes it meanwhile
            folder = RUNS / f"{name}-{n}"
            folder.mkdir()
            return folder
        n += 1


def discard(folder: Path) -> bool:
    """Remove the folder of a run that has recorded nothing; return whether it is removed."""
    if any(path.stat().st_size for path in folder.glob("*.mcap")):
        return False
    for path in (*folder.glob("*.mcap"), folder / "config.yaml"):
        path.unlink(missing_ok=True)
    with contextlib.suppress(OSError):  # it contains other files
        folder.rmdir()
    return not folder.exists()


def point_latest_to(folder: Path) -> None:
    """Point `runs/latest` to the newest run, if the file system supports symbolic links."""
    latest = folder.parent / "latest"
    with contextlib.suppress(OSError):
        if latest.is_symlink():
            latest.unlink()
        latest.symlink_to(folder.name, target_is_directory=True)
