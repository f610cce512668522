"""How a relay sleeps: until a datagram waits in a socket or an instant is near, whichever is first.

`TimerWait` (Linux) lets epoll watch the sockets and a timerfd, which fires to the microsecond where
epoll's own timeout is rounded up to 1 ms. `SelectWait` does without: select's timeout is exact to
the kernel's timer slack, which `tighten_slack` takes away.
"""

from __future__ import annotations

import ctypes
import os
import select
import socket
import sys
import time
from collections.abc import Callable, Collection, Sequence
from typing import Protocol

_CLOCK_MONOTONIC = 1
_TIMER_ABSTIME = 1
_TIMER_FLAGS = os.O_NONBLOCK | getattr(os, "O_CLOEXEC", 0)
_SET_TIMERSLACK = 29
_SECOND_NS = 1_000_000_000


class Wait(Protocol):
    """Sleeps until there is something to do."""

    def until(self, due_ns: int | None, timeout: float) -> Collection[int]:
        """Sleep until a socket can be read, until an instant, or for a time, whichever is first.

        Args:
            due_ns: The instant [ns], monotonic clock; one that has passed only looks at the
                sockets; None if there is none.
            timeout: Longest sleep [s].

        Returns:
            Descriptors of the sockets that can be read.
        """
        ...

    def close(self) -> None:
        """Give back what the kernel lent."""
        ...


def best_wait(sockets: Sequence[socket.socket]) -> Wait:
    """Take the more exact of the two that this machine has."""
    try:
        return TimerWait(sockets)
    except (AttributeError, OSError):  # not Linux, or no descriptors left
        return SelectWait(sockets)


def tighten_slack() -> None:
    """Let timeouts of the calling thread end when they are due, not up to 50 us later.

    Source: PR_SET_TIMERSLACK, prctl(2). Where there is no such call nothing happens.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_SET_TIMERSLACK, ctypes.c_ulong(1), 0, 0, 0)


class SelectWait:
    """Sleeps in select."""

    def __init__(self, sockets: Sequence[socket.socket]) -> None:
        """Watch these sockets, which stay their owner's."""
        self._sockets = list(sockets)

    def until(self, due_ns: int | None, timeout: float) -> Collection[int]:
        """Sleep, at most `timeout` [s]; see `Wait`."""
        if due_ns is not None:
            timeout = min(timeout, max(0.0, (due_ns - time.monotonic_ns()) * 1e-9))
        readable, _, _ = select.select(self._sockets, (), (), timeout)
        return [one.fileno() for one in readable]

    def close(self) -> None:
        """See `Wait`."""


class TimerWait:
    """Sleeps in epoll beside a timerfd; Linux only."""

    def __init__(self, sockets: Sequence[socket.socket]) -> None:
        """Watch these sockets, which stay their owner's.

        Raises:
            AttributeError: If this system has no epoll or no timerfd.
            OSError: If the kernel gives none.
        """
        self._poll = select.epoll()
        self._timer, self._arm = _timer()
        self._armed_ns = -1
        self._names = {one.fileno() for one in sockets}
        for name in self._names:
            self._poll.register(name, select.EPOLLIN)
        # Edge-triggered: one that has fired need not be read, only armed again.
        self._poll.register(self._timer, select.EPOLLIN | select.EPOLLET)

    def until(self, due_ns: int | None, timeout: float) -> Collection[int]:
        """Sleep, at most `timeout` [s]; see `Wait`."""
        if due_ns is not None:
            if due_ns <= time.monotonic_ns():
                timeout = 0.0
            elif due_ns != self._armed_ns:
                self._arm(due_ns)
                self._armed_ns = due_ns
        return [name for name, _ in self._poll.poll(timeout) if name in self._names]

    def close(self) -> None:
        """See `Wait`."""
        self._poll.close()
        os.close(self._timer)


if sys.version_info >= (3, 13):

    def _timer() -> tuple[int, Callable[[int], object]]:
        """Make a timerfd, and what arms it for an instant [ns]."""
        timer = os.timerfd_create(time.CLOCK_MONOTONIC, flags=_TIMER_FLAGS)

        def arm(due_ns: int) -> object:
            return os.timerfd_settime_ns(timer, flags=os.TFD_TIMER_ABSTIME, initial=due_ns)

        return timer, arm

else:

    class _TimerSetting(ctypes.Structure):
        """`struct itimerspec` of the C library: period, then first instant."""

        _fields_ = (
            ("period_s", ctypes.c_long),
            ("period_ns", ctypes.c_long),
            ("first_s", ctypes.c_long),
            ("first_ns", ctypes.c_long),
        )

    def _timer() -> tuple[int, Callable[[int], object]]:
        """Make a timerfd, and what arms it for an instant [ns]."""
        library = ctypes.CDLL(None, use_errno=True)
        timer = library.timerfd_create(_CLOCK_MONOTONIC, _TIMER_FLAGS)
        if timer < 0:
            raise OSError(ctypes.get_errno(), "no timerfd")
        setting = _TimerSetting()
        where, set_time = ctypes.byref(setting), library.timerfd_settime

        def arm(due_ns: int) -> object:
            setting.first_s, setting.first_ns = divmod(due_ns, _SECOND_NS)
            return set_time(timer, _TIMER_ABSTIME, where, None)

        return timer, arm
