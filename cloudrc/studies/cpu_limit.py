# SPDX-License-Identifier: Apache-2.0

"""Limit the processor time of this process, and keep it in step with virtual time."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from cloudrc.flight.machine import CGROUPS, control_groups

QUOTA_PERIOD_US = 100_000
"""Time of which a limit gives a share [us].
Source: Linux, Documentation/scheduler/sched-bwc.rst."""


@contextmanager
def cpu_limit(cpus: float) -> Iterator[str]:
    """Limit this process to `cpus` processors [1] in the `with` block, as a container is.

    Yield why that was not possible; "" if it was. It takes the permission to make a control group.
    """
    why = "this system has no control groups"
    for home, parent, limits in _groups(round(cpus * QUOTA_PERIOD_US)):
        own = parent / f"cloudrc-{os.getpid()}"
        try:
            own.mkdir()
            for name, value in limits.items():
                (own / name).write_text(value)
            (own / "cgroup.procs").write_text(str(os.getpid()))
        except OSError as error:
            why = f"{error.filename}: {error.strerror}"
            _remove(own)
            continue
        try:
            yield ""
        finally:
            (home / "cgroup.procs").write_text(str(os.getpid()))
            _remove(own)
        return
    yield why


def _groups(quota_us: int) -> Iterator[tuple[Path, Path, Mapping[str, str]]]:
    """Yield a control group of this process, the place for a new one, and the limit's files.

    In version 2 a group with processes has no groups with limits in it, so the new one may have to
    be in a group above.
    """
    for names, home in control_groups():
        if not names:
            for parent in (home, *home.parents):
                if parent.is_relative_to(CGROUPS) and (parent / "cgroup.procs").exists():
                    yield home, parent, {"cpu.max": f"{quota_us} {QUOTA_PERIOD_US}"}
        elif "cpu" in names.split(","):
            files = {"cpu.cfs_period_us": QUOTA_PERIOD_US, "cpu.cfs_quota_us": quota_us}
            yield home, home, {name: str(value) for name, value in files.items()}


def _remove(group: Path) -> None:
    """Remove a control group, unless a process is in it or it was not made."""
    processes = group / "cgroup.procs"
    if processes.exists() and not processes.read_text():
        group.rmdir()


class PacedClock:
    """A clock of real time [ns] that waits until a virtual time has come in real time, too."""

    def __init__(self) -> None:
        """Begin with the first call; then set `virtual_ns`, which returns the virtual time [ns]."""
        self.virtual_ns: Callable[[], int] = lambda: 0
        self._start_ns: int | None = None

    def __call__(self) -> int:
        """Wait, and return the time [ns]."""
        virtual_ns = self.virtual_ns()
        if self._start_ns is None:
            self._start_ns = time.perf_counter_ns() - virtual_ns
        wait_ns = self._start_ns + virtual_ns - time.perf_counter_ns()
        time.sleep(max(0, wait_ns) * 1e-9)
        return time.perf_counter_ns()
