"""Describe this machine: its monotonic clock and its Python interpreter.

`Deadline` is a time limit on the monotonic clock, for a process that waits for others.
"""

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
    """Identify the monotonic clock: two processes with the same 16 bytes share it.

    The kernel's boot id identifies the clock, since each boot restarts the clock. Without a boot id
    the bytes are random: then the ends do not share a clock, and one-way delays are not reported.
    """
    text = _boot_id().replace("-", "").strip()
    try:
        boot = bytes.fromhex(text)
    except ValueError:
        boot = b""
    return boot if len(boot) == 16 else os.urandom(16)


def _boot_id() -> str:
    try:
        return LINUX_BOOT_ID.read_text()
    except OSError:
        pass
    try:
        return subprocess.run(MACOS_BOOT_ID, capture_output=True, text=True, timeout=5).stdout
    except (OSError, subprocess.SubprocessError):
        return ""


def interpreter(*words: str) -> list[str]:
    """Build a command that runs this Python interpreter, for example with `-m cloudrc relay`.

    Python imports from the working folder first, which may be a run from somebody else. The new
    process imports from there only if this process does, for example under `python -m`.
    """
    here = os.getcwd() in sys.path or "" in sys.path
    return [sys.executable, *(() if here else ("-P",)), *words]


class Deadline:
    """A time limit that does not count the time in which this process itself stood still.

    A process that was stopped, or whose container was paused, cannot tell what others did in the
    meantime. It has to give the others this time in addition.

    Attributes:
        pause: Total time for which this process stood still [s].
    """

    def __init__(
        self, limit: float, turn_max: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Start the time limit.

        Args:
            limit: Time until the limit has passed [s].
            turn_max: Longest time between two calls of `passed` while this process runs [s].
            clock: A monotonic clock [s].
        """
        self._left, self._turn_max, self._clock = limit, turn_max, clock
        self._before = clock()
        self.pause = 0.0

    def passed(self) -> bool:
        """Check whether the limit has passed; call it in every turn of a loop."""
        now = self._clock()
        turn, self._before = now - self._before, now
        if turn > self._turn_max:
            self.pause += turn
        else:
            self._left -= turn
        return self._left < 0.0
