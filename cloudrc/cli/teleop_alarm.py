"""The emergency stop past teleop's loop: one datagram to cloud, repeated where it is not taken."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

REPEAT_PERIOD = 0.02
"""Between two tries [s]."""
REPEAT_LIMIT = 2.0
"""After the operator's word [s]: who has not had an answer by then asks again, and a cloud that
stands still for so long has a robot that holds."""


class Alarm:
    """Tells cloud to stop the rotors; may be called from any thread, and waits for nobody.

    A cloud that stands still lets eleven datagrams wait, and refuses what comes then. Teleop's loop
    would say it again, but may itself be waiting for its disk: so a thread says it until cloud has
    taken it, and goes.
    """

    def __init__(self, send: Callable[[], bool]) -> None:
        """Begin.

        Args:
            send: Sends it, if cloud takes it now; says whether it did. Must not block.
        """
        self._send = send
        self._lock = threading.Lock()
        self._until = 0.0
        self._repeats = False  # there is such a thread

    def __call__(self) -> None:
        """Send it, now or as soon as cloud takes it."""
        with self._lock:
            if self._send():
                self._until = 0.0  # once is enough
                return
            self._until = time.monotonic() + REPEAT_LIMIT
            if self._repeats:
                return
            try:
                threading.Thread(target=self._repeat, name="alarm", daemon=True).start()
            except RuntimeError:  # there can be no more threads: it is left to teleop's loop
                return
            self._repeats = True

    def _repeat(self) -> None:
        while self._repeats_after(REPEAT_PERIOD):
            pass

    def _repeats_after(self, period: float) -> bool:
        """Wait, then try again; say whether it has to be tried once more."""
        time.sleep(period)
        with self._lock:  # whoever asks meanwhile finds a thread that goes on, or none
            self._repeats = time.monotonic() < self._until and not self._send()
            return self._repeats
