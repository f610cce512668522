"""End child processes, which may have ended by themselves."""

from __future__ import annotations

import os
import subprocess
from contextlib import suppress
from typing import Any


def signal_group(process: subprocess.Popen[Any], number: int) -> None:
    """Send a signal to the process group that a process leads, if some of it still runs."""
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, number)


def await_or_kill(process: subprocess.Popen[Any], limit: float) -> None:
    """Wait at most `limit` [s] for the end of a process, then kill it."""
    with suppress(subprocess.TimeoutExpired):
        process.wait(limit)
    process.kill()
    process.wait()
