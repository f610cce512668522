"""What a process knows of its machine: whose monotonic clock it reads, which cipher is fast.

Python again: what a process of its own is to run goes in, the words of its command come out.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

LINUX_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
CPU_INFO = Path("/proc/cpuinfo")
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


def has_fast_aes() -> bool:
    """Whether the processor computes AES itself; where nobody can say, it is taken to."""
    try:
        lines = CPU_INFO.read_text(errors="replace").splitlines()
    except OSError:
        return True
    flags = [line for line in lines if line.lower().startswith(("flags", "features"))]
    return not flags or "aes" in flags[0].split()


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
    """Put this interpreter before its words, as `-m cloudrc relay`.

    Python looks into the working folder first, which may be a run got from somebody else: the new
    process does so only if this one does, as below `python -m`.
    """
    here = os.getcwd() in sys.path or "" in sys.path
    return [sys.executable, *(() if here else ("-P",)), *words]
