"""Keep what has to be done at which time; the clock is that of the caller."""

from __future__ import annotations

from collections.abc import Callable
from heapq import heappop, heappush
from typing import Any

from cloudrc.link.queue import NOTHING_NS


class Agenda:
    """Calls in the order of their times; calls at the same time keep the order of `at`.

    Attributes:
        next_ns: Time of the next call [ns]; `NOTHING_NS` if there is none.
    """

    def __init__(self) -> None:
        self._calls: list[tuple[int, int, Callable[..., None], tuple[Any, ...]]] = []
        self._count = 0
        self.next_ns = NOTHING_NS

    def at(self, time_ns: int, call: Callable[..., None], *arguments: Any) -> None:
        """Call `call(*arguments, now_ns)` at the time `time_ns` [ns] or soon after."""
        self._count += 1
        heappush(self._calls, (time_ns, self._count, call, arguments))
        self.next_ns = self._calls[0][0]

    def run(self, now_ns: int) -> None:
        """Make all calls that are due at `now_ns` [ns].

        Each call gets the time at which it was due, so that a late caller does not slow a stream.
        """
        calls = self._calls
        while calls and calls[0][0] <= now_ns:
            time_ns, _, call, arguments = heappop(calls)
            call(*arguments, time_ns)
        self.next_ns = calls[0][0] if calls else NOTHING_NS
