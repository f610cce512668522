# SPDX-License-Identifier: Apache-2.0

"""Find clock, usable cores and Python of the machine; end child processes."""

from __future__ import annotations

import os
import subprocess
import sys
import time
import uuid
from collections.abc import Callable
from contextlib import suppress
from math import ceil
from pathlib import Path
from typing import Any

LINUX_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
CGROUP, CGROUPS = Path("/proc/self/cgroup"), Path("/sys/fs/cgroup")
"""File with the control groups of this process, and folder of all groups."""
STOP_LIMIT = 2.0
"""Time from SIGTERM to SIGKILL, in which a program can end by itself [s]."""
MACOS_BOOT_ID = ("sysctl", "-n", "kern.bootsessionuuid")


def clock_id() -> bytes:
    """Return 16 bytes that identify this machine's monotonic clock: the boot id of the kernel.

    World and cloud measure one-way delays only if both have the same bytes. If the kernel has no
    boot id, the bytes are random: world and cloud differ, and measure no one-way delays.
    """
    try:
        if LINUX_BOOT_ID.exists():
            text = LINUX_BOOT_ID.read_text()
        else:
            text = subprocess.run(MACOS_BOOT_ID, capture_output=True, text=True, timeout=5).stdout
        return uuid.UUID(text.strip()).bytes
    except (OSError, subprocess.SubprocessError, ValueError):
        return os.urandom(16)


def usable_cores() -> int:
    """Return how many cores this process may use: by its affinity and by its CPU limit.

    The CPU limit is the lowest limit of the process's control group (version 2) and its parents.
    """
    affinity = getattr(os, "sched_getaffinity", None)  # not on macOS
    cores = len(affinity(0)) if affinity else os.cpu_count() or 1
    for names, group in control_groups():
        for file in (folder / "cpu.max" for folder in (group, *group.parents) if not names):
            quota, period = file.read_text().split() if file.exists() else ("max", "")
            if quota != "max":
                cores = min(cores, max(1, ceil(int(quota) / int(period))))
    return cores


def control_groups() -> list[tuple[str, Path]]:
    """Return the control groups of this process: names of their controllers, and folder.

    That of version 2 has no names.
    """
    lines = CGROUP.read_text().splitlines() if CGROUP.exists() else []
    parts = (line.split(":", 2)[1:] for line in lines)
    return [(names, CGROUPS / names / path.strip("/")) for names, path in parts]


def interpreter(*words: str) -> list[str]:
    """Build a command line for this Python interpreter, such as with `-m cloudrc process world`.

    The new process imports modules from the working folder only if this process does: the folder
    may contain files from somebody else.
    """
    here = os.getcwd() in sys.path or "" in sys.path
    return [sys.executable, *(() if here else ("-P",)), *words]


class AwakeClock:
    """A monotonic clock that stands still while this process is suspended.

    Attributes:
        pause: Total time for which this process was suspended [s].
    """

    def __init__(self, turn_max: float, clock: Callable[[], float] = time.monotonic) -> None:
        """Begin at 0 s; `clock` is the machine's [s].

        If more than `turn_max` [s] pass between two calls, this process was suspended meanwhile.
        """
        self._turn_max, self._clock, self._before = turn_max, clock, clock()
        self._now = self.pause = 0.0

    def __call__(self) -> float:
        """Return the time [s]; the caller's loop calls this in every turn."""
        before, self._before = self._before, self._clock()
        turn = self._before - before
        if turn > self._turn_max:
            self.pause += turn
        else:
            self._now += turn
        return self._now


def signal_group(process: subprocess.Popen[Any], number: int) -> None:
    """Send a signal to the process group that a process leads, if some of it still runs."""
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, number)


def await_or_kill(process: subprocess.Popen[Any], limit: float) -> None:
    """Wait at most `limit` [s] for the end of a process, then kill it."""
    try:
        process.wait(limit)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def end_process(process: subprocess.Popen[Any]) -> None:
    """End a program by SIGTERM, and by SIGKILL after `STOP_LIMIT`."""
    process.terminate()
    await_or_kill(process, STOP_LIMIT)
