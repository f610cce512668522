"""Find clock, usable cores and Python of the machine; time limits that exclude suspended time."""

from __future__ import annotations

import os
import subprocess
import sys
import time
import uuid
from collections.abc import Callable
from math import ceil
from pathlib import Path

LINUX_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
CGROUP, CGROUPS = Path("/proc/self/cgroup"), Path("/sys/fs/cgroup")
"""File with the control groups of this process, and folder of all groups."""
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
    lines = CGROUP.read_text().splitlines() if CGROUP.exists() else []
    groups = [CGROUPS / line[3:].strip("/") for line in lines if line.startswith("0::")]
    for group in groups:
        for file in (folder / "cpu.max" for folder in (group, *group.parents)):
            quota, period = file.read_text().split() if file.exists() else ("max", "")
            if quota != "max":
                cores = min(cores, max(1, ceil(int(quota) / int(period))))
    return cores


def interpreter(*words: str) -> list[str]:
    """Build a command line for this Python interpreter, for example with `-m cloudrc world`.

    The new process imports modules from the working folder only if this process does: the folder
    may contain files from somebody else.
    """
    here = os.getcwd() in sys.path or "" in sys.path
    return [sys.executable, *(() if here else ("-P",)), *words]


class Deadline:
    """A time limit that excludes the time for which this process was suspended.

    Attributes:
        pause: Total time for which this process was suspended [s].
    """

    def __init__(
        self, limit: float, turn_max: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Start a time limit of `limit` [s] by a monotonic `clock` [s].

        If more than `turn_max` [s] pass between two calls of `passed`, this process was suspended,
        and the limit excludes this time.
        """
        self._left, self._turn_max, self._clock = limit, turn_max, clock
        self._before = clock()
        self.pause = 0.0

    def passed(self) -> bool:
        """Return whether the time limit has passed; the caller's loop calls this in every turn."""
        now = self._clock()
        turn, self._before = now - self._before, now
        if turn > self._turn_max:
            self.pause += turn
        else:
            self._left -= turn
        return self._left < 0.0
