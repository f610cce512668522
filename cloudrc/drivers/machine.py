"""Describe this machine: its monotonic clock and its Python interpreter."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

LINUX_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
MACOS_BOOT_ID = ("sysctl", "-n", "kern.bootsessionuuid")


def clock_id() -> bytes:
    """Identify the monotonic clock: two processes with the same 16 bytes share it.

    The kernel's boot id identifies it, since each boot restarts the clock. Without a boot id the
    bytes are random: then the ends do not share a clock, and one-way delays are not reported.
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
    """Build a command that runs this Python interpreter, such as with `-m cloudrc relay`.

    Python imports from the working folder first, which may be a run from somebody else. The new
    process does so only if this one does, for example under `python -m`.
    """
    here = os.getcwd() in sys.path or "" in sys.path
    return [sys.executable, *(() if here else ("-P",)), *words]
