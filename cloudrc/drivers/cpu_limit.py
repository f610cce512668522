"""Limit the processor time of this process, and keep it in step with virtual time."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from cloudrc.drivers.machine import CGROUP, CGROUPS

QUOTA_PERIOD_US = 100_000
"""Time of which a limit gives a share [us].
Source: Linux, Documentation/scheduler/sched-bwc.rst."""


@contextmanager
def cpu_limit(cpus: float) -> Iterator[str]:
    """Limit this process to a number of processors in the `with` block, as a container is.

    Yield why that was not possible; "" if it was. It takes the permission to make a control group.
    """
    errors = list[str]()
    for parent, limits in _groups(round(cpus * QUOTA_PERIOD_US)):
        own = parent / f"cloudrc-{os.getpid()}"
        try:
            own.mkdir()
            for name, value in limits.items():
                (own / name).write_text(value)
            (own / "cgroup.procs").write_text(str(os.getpid()))
        except OSError as error:
            errors.append(f"{own}: {error.strerror}")
            _remove(own)
            continue
        try:
            yield ""
        finally:
            (parent / "cgroup.procs").write_text(str(os.getpid()))
            _remove(own)
        return
    yield "; ".join(errors) or "this system has no control groups"


def _groups(quota_us: int) -> Iterator[tuple[Path, Mapping[str, str]]]:
    """Yield control groups of this process, and files with the limit for a new one in them."""
    lines = CGROUP.read_text().splitlines() if CGROUP.exists() else []
    for names, path in (line.split(":", 2)[1:] for line in lines):
        if not names:
            yield CGROUPS / path.strip("/"), {"cpu.max": f"{quota_us} {QUOTA_PERIOD_US}"}
        elif "cpu" in names.split(","):
            files = {"cpu.cfs_period_us": QUOTA_PERIOD_US, "cpu.cfs_quota_us": quota_us}
            values = {name: str(value) for name, value in files.items()}
            yield CGROUPS / names / path.strip("/"), values


def _remove(group: Path) -> None:
    with suppress(OSError):
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
