"""What a relay's process asks of the machine, so that it runs when a datagram is due."""

from __future__ import annotations

import gc
import os
import sys

_FIFO_PRIORITY = 10
"""Above every ordinary process, below the kernel's own threads (50)."""
_SWITCH_INTERVAL = 0.0002
_COLLECT_AFTER = 50_000
"""Objects in flight are no garbage: the collector need not look at them so often."""


def settle() -> None:
    """Keep what is loaded from the collector's eyes, and other threads from holding this one up.

    A thread that answers Prometheus keeps the interpreter for at most 0.2 ms, not Python's 5 ms.
    """
    sys.setswitchinterval(_SWITCH_INTERVAL)
    gc.collect()
    gc.freeze()
    gc.set_threshold(_COLLECT_AFTER)


def ask_for_fifo() -> str:
    """Let the calling thread run before every ordinary one, if it may.

    Threads and processes that it starts are ordinary again.

    Returns:
        "" if it does, else why it does not.
    """
    if not hasattr(os, "SCHED_FIFO"):
        return "this system has no SCHED_FIFO"
    try:
        policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
        os.sched_setscheduler(0, policy, os.sched_param(_FIFO_PRIORITY))
    except OSError as error:
        return f"{error.strerror}; it takes CAP_SYS_NICE or a limit on rtprio"
    return ""


def runs_first() -> bool:
    """Say whether the calling thread runs before every ordinary one."""
    if not hasattr(os, "SCHED_FIFO"):
        return False
    return os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO
