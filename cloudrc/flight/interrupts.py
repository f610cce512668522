# SPDX-License-Identifier: Apache-2.0

"""Interrupt a command on SIGINT, SIGTERM and SIGHUP, and remember that it was interrupted.

A library may catch the exception of the handler: the code of MuJoCo that starts in its import turns
it into an ImportError. So commands with much work also ask `is_interrupted`.
"""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType, SimpleNamespace

_state = SimpleNamespace(asked=False, only_notes=False)
"""Whether a signal has asked this process to end, and whether it then raises no exception."""


def _ask(number: int, frame: FrameType | None) -> None:
    if number == signal.SIGHUP:
        # The shell and the kernel each send one; the second must not interrupt the report.
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
    _state.asked = True
    if not _state.only_notes:
        raise KeyboardInterrupt


def interrupt_on_signals() -> None:
    """Raise KeyboardInterrupt on SIGINT, SIGTERM and SIGHUP; earlier signals do not count.

    A signal that this process ignores, such as SIGHUP under `nohup`, stays ignored. SIGTERM never
    does: the first process of a container ignores it by default.
    """
    forget_interrupt()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if number == signal.SIGTERM or signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _ask)


@contextmanager
def noted_interrupts() -> Iterator[None]:
    """Raise no exception on a signal inside the block, which has to ask `raise_if_interrupted`.

    An exception at any line would leave a lock of `concurrent.futures` taken for ever.
    """
    before, _state.only_notes = _state.only_notes, True
    try:
        yield
    finally:
        _state.only_notes = before


def is_interrupted() -> bool:
    """Return whether a signal has asked this process to end."""
    return bool(_state.asked)


def forget_interrupt() -> None:
    """Begin a new command: earlier signals do not count."""
    _state.asked = False


def raise_if_interrupted() -> None:
    """Raise KeyboardInterrupt if a signal has asked this process to end."""
    if _state.asked:
        raise KeyboardInterrupt


def until_interrupted() -> suppress:
    """Run the block, which may be endless, until the user interrupts it; then go on behind it."""
    return suppress(KeyboardInterrupt)
