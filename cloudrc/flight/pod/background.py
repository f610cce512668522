# SPDX-License-Identifier: Apache-2.0

"""Make calls that may take long in a thread, so that the loop of a real-time process goes on."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from queue import Empty, SimpleQueue
from typing import Any

from cloudrc.base.outside.code import attempt
from cloudrc.wire.endpoint import Outcome

SWITCH = 0.0005
"""Time after which a busy thread lets the loop run [s]; Python's default is 5 ms."""


class Background:
    """A worker of real time; its thread ends with the process."""

    def __init__(self, extra_ns: Callable[[int], int] | None) -> None:
        """Start the thread.

        `extra_ns` returns the emulated duration [ns] that comes on top of the true one, of a call
        that began at a time [ns]; None: no time.
        """
        sys.setswitchinterval(SWITCH)
        self._extra_ns = extra_ns
        self._calls = SimpleQueue[Callable[[], Any]]()
        self._outcomes = SimpleQueue[Outcome]()
        threading.Thread(target=self._run, daemon=True).start()

    def begin(self, call: Callable[[], Any], now_ns: int) -> None:
        """Begin a call as soon as the thread wakes."""
        self._calls.put(call)

    def take(self) -> Outcome | None:
        """Return the outcome once."""
        try:
            return self._outcomes.get_nowait()
        except Empty:
            return None

    def _run(self) -> None:
        while True:
            call = self._calls.get()
            begun_ns = time.monotonic_ns()
            result, error = attempt(call)
            extra_ns = self._extra_ns(begun_ns) if self._extra_ns else 0
            done_ns = time.monotonic_ns() + extra_ns
            self._outcomes.put(Outcome(result, error, begun_ns, done_ns))
