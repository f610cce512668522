# SPDX-License-Identifier: Apache-2.0

"""Make the folder of a run or of a sweep."""

from __future__ import annotations

import contextlib
import itertools
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from cloudrc.base.outside.paths import LOCK, lock_folder, make_folder

if TYPE_CHECKING:
    from cloudrc.config.resolved import ResolvedExperiment

RUNS = Path("runs")
"""Folder for runs, in the working folder."""


def run_folder(experiment: ResolvedExperiment, mode: str, out: Path | None) -> Path:
    """Make the folder of a run, as `new_folder` does; `mode` is a mode, or "session".

    The pods of a cluster may not fly, so that `runs/latest` points to their run only later.
    """
    name = f"{experiment.name}-{mode}-seed{experiment.seed}"
    return new_folder(out, name, "" if mode == "cluster" else "latest")


def new_folder(
    out: Path | None,
    name: str,
    link: str = "latest",
    *,
    flag: str = "--out",
) -> Path:
    """Make the folder of a run: `out`, or the next free `runs/<name>-<n>`.

    Without `out`, point the symbolic link `runs/<link>` to the new folder; "" for no link.
    `flag` is the flag that gave `out`, which must be new or empty.
    """
    if out is not None:
        make_folder(out, f"{flag} ")
        return out
    RUNS.mkdir(exist_ok=True)
    for n in itertools.count(1):
        folder = RUNS / f"{name.replace(':', '-')}-{n}"  # some file systems have no colon
        with contextlib.suppress(FileExistsError):  # another process may make it first
            folder.mkdir()
            break
    if link:
        point_to(folder, link)
    return folder


@contextlib.contextmanager
def results_folder(out: Path | None, study: str, name: str) -> Iterator[Path]:
    """Lock the folder of a study's rows: `out` of an earlier call, else one of `new_folder`."""
    if out is None or not (out / LOCK).exists():
        out = new_folder(out, f"{study}-{name}", f"latest-{study}")
    with lock_folder(out):
        yield out


def point_to(folder: Path, link: str) -> None:
    """Let the symbolic link `link`, beside `folder`, point to `folder`; ignore a failure.

    A copy of `runs` may have a folder in the place of the link, which the log tells.
    """
    latest = folder.parent / link
    if latest.exists() and not latest.is_symlink():
        logging.getLogger("cloudrc").warning(
            "%s is no link and stays as it is; remove it, then it shows the newest run", latest
        )
    with contextlib.suppress(OSError):
        if latest.is_symlink():
            latest.unlink()
        latest.symlink_to(folder.name, target_is_directory=True)
