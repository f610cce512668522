"""Signals that ask a command to end, whoever sends them: a person, a batch system, a terminal."""

from __future__ import annotations

import signal
from types import FrameType


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
