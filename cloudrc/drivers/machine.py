"""This machine: its monotonic clock, time limits by it, and its Python interpreter."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

LINUX_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
MACOS_BOOT_ID = ("sysctl", "-n", "kern.bootsessionuuid")


def clock_id() -> bytes:
    """Return 16 bytes that identify the monotonic clock: the kernel's boot id.

    Processes with equal bytes share the clock. Without a boot id the bytes are random, and no
    one-way delays are reported.
    """
    try:
        boot = bytes.fromhex(_boot_id().replace("-", "").strip())
    except (OSError, subprocess.SubprocessError, ValueError):
        boot = b""
    return boot if len(boot) == 16 else os.urandom(16)


def _boot_id() -> str:
    if LINUX_BOOT_ID.exists():
        return LINUX_BOOT_ID.read_text()
    return subprocess.run(MACOS_BOOT_ID, capture_output=True, text=True, timeout=5).stdout


def interpreter(*words: str) -> list[str]:
    """Build a command that runs this Python interpreter, for example with `-m cloudrc relay`.

    The working folder may hold a run from somebody else. The new process imports from this folder
    only if the present process does, for example under `python -m`.
    """
    here = os.getcwd() in sys.path or "" in sys.path
    return [sys.executable, *(() if here else ("-P",)), *words]


class Deadline:
    """A time limit that does not count the time in which this process itself stood still.

    Attributes:
        pause: Total time for which this process stood still [s].
    """

    def __init__(
        self, limit: float, turn_max: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Start a time limit of `limit` [s] by a monotonic `clock` [s].

        `turn_max` [s] is the longest time between two calls of `passed` while this process runs.
        """
        self._left, self._turn_max, self._clock = limit, turn_max, clock
        self._before = clock()
        self.pause = 0.0

    def passed(self) -> bool:
        """Check whether the limit has passed; to be called in every turn of a loop."""
        now = self._clock()
        turn, self._before = now - self._before, now
        if turn > self._turn_max:
            self.pause += turn
        else:
            self._left -= turn
        return self._left < 0.0
