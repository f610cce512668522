"""What a process knows of the machine that it runs on: whose monotonic clock it reads."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

LINUX_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
MACOS_BOOT_ID = ("sysctl", "-n", "kern.bootsessionuuid")


def clock_id() -> bytes:
    """Name the monotonic clock: two processes share it if and only if they get the same 16 bytes.

    The kernel's boot id names it, since every boot starts a clock anew. Where there is none, the
    bytes are random: then nobody shares the clock, and one-way delays are not reported.
    """
    text = _boot_id().replace("-", "").strip()
    try:
        named = bytes.fromhex(text)
    except ValueError:
        named = b""
    return named if len(named) == 16 else os.urandom(16)


def _boot_id() -> str:
    try:
        return LINUX_BOOT_ID.read_text()
    except OSError:
        pass
    try:
        return subprocess.run(MACOS_BOOT_ID, capture_output=True, text=True, timeout=5).stdout
    except (OSError, subprocess.SubprocessError):
        return ""
