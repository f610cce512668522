# SPDX-License-Identifier: Apache-2.0

"""Let the thread that carries packets wake up in time."""

from __future__ import annotations

import ctypes
import gc
import os
import sys
from contextlib import suppress

_FIFO_PRIORITY = 10  # above ordinary processes, below the kernel's threads (50)
_SWITCH_INTERVAL = 0.0002  # longest time for which another thread can block this one [s]
_COLLECT_AFTER = 50_000  # new objects before a garbage collection; most are packets in flight
_SET_TIMERSLACK = 29  # Source: Linux, include/uapi/linux/prctl.h; Python has no name for it


def settle() -> None:
    """Let the calling thread wake on time: collect garbage rarely, switch threads sooner."""
    sys.setswitchinterval(_SWITCH_INTERVAL)
    gc.collect()
    gc.freeze()
    gc.set_threshold(_COLLECT_AFTER)
    if sys.platform == "linux":  # else a sleep ends up to 50 us late
        ctypes.CDLL(None).prctl(_SET_TIMERSLACK, ctypes.c_ulong(1), 0, 0, 0)


def ask_for_fifo() -> bool:
    """Give the calling thread, not its child processes, the real-time class SCHED_FIFO.

    Return whether this is permitted: it takes CAP_SYS_NICE or a limit on rtprio.
    """
    with suppress(AttributeError, OSError):  # a system without SCHED_FIFO; no permission
        policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
        os.sched_setscheduler(0, policy, os.sched_param(_FIFO_PRIORITY))
        return True
    return False
