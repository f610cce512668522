"""What asks a command to end: a person, a batch system, a terminal, or that its parent is gone."""

from __future__ import annotations

import os
import signal
import threading
import time
from types import FrameType

LOOK_PERIOD = 0.5
"""How often a worker looks whether its parent is there [s]."""


def end_orderly() -> None:
    """Take SIGTERM and SIGHUP as Ctrl-C is taken: the command sees a KeyboardInterrupt.

    A SIGHUP that is ignored from the start stays so: that is what `nohup` is for.
    """
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        signal.signal(signal.SIGHUP, _hung_up)


def _hung_up(number: int, frame: FrameType | None) -> None:
    # The shell and the kernel each send one: the second must not interrupt the report.
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    raise KeyboardInterrupt


def end_with(parent: int) -> None:
    """In a worker of a pool: end when its parent is gone, which may have been killed.

    Args:
        parent: Process id of who has made the pool.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(LOOK_PERIOD)
        os._exit(1)  # there is nobody to tell, and nothing to end

    threading.Thread(target=watch, name="parent", daemon=True).start()
