"""Interrupt a command on SIGINT, SIGTERM and SIGHUP, and remember that it was interrupted.

An exception that a signal handler raises during an import can get lost: the code of MuJoCo that
starts in the import turns it into an ImportError. Pydantic turns one in a function that it calls
into a warning. The handler therefore waits until neither is under way. Other libraries may catch
the exception, too, so commands with much work ask `is_interrupted`.
"""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

IMPORTER = "<frozen importlib._bootstrap"
"""Beginning of the file name of each frame in which Python imports a module."""
SWALLOWS = "pydantic"
"""Package that may catch the exception."""
PERIOD = 0.05
"""Time between two looks whether the import or call is over [s]."""
LOOKS_MAX = 100
"""Number of looks after which the command is interrupted during its import, because a module of the
user may never end its import."""


class _Interrupt:
    """The handler of all signals that interrupt this process."""

    def __init__(self) -> None:
        self.asked = False
        self.only_notes = False
        self._looks = 0

    def ask(self, number: int, frame: FrameType | None) -> None:
        """Interrupt the process, if it imports a module only once the import is over."""
        if number == signal.SIGHUP:
            # The shell and the kernel each send one; the second must not interrupt the report.
            signal.signal(signal.SIGHUP, signal.SIG_IGN)
        first, self.asked = not self.asked, True
        if self.only_notes:
            return
        if first and _may_get_lost(frame):
            self._looks = 0
            signal.signal(signal.SIGALRM, self._look)
            signal.setitimer(signal.ITIMER_REAL, PERIOD, PERIOD)
            return
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        raise KeyboardInterrupt

    def _look(self, number: int, frame: FrameType | None) -> None:
        self._looks += 1
        if self._looks < LOOKS_MAX and _may_get_lost(frame):
            return
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        raise KeyboardInterrupt


_interrupt = _Interrupt()


def _may_get_lost(frame: FrameType | None) -> bool:
    """Return whether `frame` or one of its callers may catch an exception of the handler."""
    while frame is not None:
        if frame.f_code.co_filename.startswith(IMPORTER):
            return True
        if str(frame.f_globals.get("__name__")).partition(".")[0] == SWALLOWS:
            return True
        frame = frame.f_back
    return False


def interrupt_on_signals() -> None:
    """Raise KeyboardInterrupt on SIGINT, SIGTERM and SIGHUP, but not during an import.

    A signal that this process ignores, such as SIGHUP under `nohup`, stays ignored. SIGTERM never
    does: the first process of a container ignores it by default.
    """
    forget_interrupt()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if number == signal.SIGTERM or signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _interrupt.ask)


@contextmanager
def noted_interrupts() -> Iterator[None]:
    """Raise no exception on a signal inside the block, which has to ask `raise_if_interrupted`.

    An exception at any line would leave a lock of `concurrent.futures` taken for ever.
    """
    before, _interrupt.only_notes = _interrupt.only_notes, True
    try:
        yield
    finally:
        _interrupt.only_notes = before


def is_interrupted() -> bool:
    """Return whether a signal has asked this process to end."""
    return _interrupt.asked


def forget_interrupt() -> None:
    """Begin a new command: earlier signals do not count."""
    _interrupt.asked = False


def raise_if_interrupted() -> None:
    """Raise KeyboardInterrupt if a signal has asked this process to end."""
    if _interrupt.asked:
        raise KeyboardInterrupt
