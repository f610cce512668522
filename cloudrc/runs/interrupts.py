"""Interrupt a command on SIGINT, SIGTERM and SIGHUP, and remember that it was interrupted.

A library may catch the exception of the handler: the code of MuJoCo that starts in its import turns
it into an ImportError. So commands with much work also ask `is_interrupted`.
"""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType


class _Interrupt:
    """The handler of all signals that interrupt this process."""

    def __init__(self) -> None:
        self.asked = False
        self.only_notes = False

    def ask(self, number: int, frame: FrameType | None) -> None:
        """Interrupt the process."""
        if number == signal.SIGHUP:
            # The shell and the kernel each send one; the second must not interrupt the report.
            signal.signal(signal.SIGHUP, signal.SIG_IGN)
        self.asked = True
        if not self.only_notes:
            raise KeyboardInterrupt


_interrupt = _Interrupt()


def interrupt_on_signals() -> None:
    """Raise KeyboardInterrupt on SIGINT, SIGTERM and SIGHUP.

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


def until_interrupted() -> suppress:
    """Run the block, which may be endless, until the user interrupts it; then go on behind it."""
    return suppress(KeyboardInterrupt)
