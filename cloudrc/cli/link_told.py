"""What `cloudrc link run` answers at /link.json of its metrics' port: who shapes, by what, and how.

Tools are started for each answer, so that nobody may have one more often than once a second.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from cloudrc.cli.tc_session import runner
from cloudrc.link.sidecar import Near, look_near, write_told

if TYPE_CHECKING:
    from cloudrc.link.sidecar import Sidecar

PERIOD = 1.0
"""For so long an answer is given again [s]."""
NOTHING = "{}\n"
"""Before anything is shaped."""


def look(host: str, inside: Sequence[str] = ()) -> Near | None:
    """Ask a network namespace for its netems and its way to a host, with tools of our own.

    Args:
        host: IPv4 address.
        inside: Words that lead there, "ip netns exec NAME"; none: this one.
    """
    programs = runner("", inside)
    try:
        return look_near(programs, host)
    finally:
        programs.close()


class Teller:
    """Tells what a sidecar does, to any thread."""

    def __init__(
        self,
        sidecar: Sidecar,
        look: Callable[[str], Near | None] = look,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._sidecar, self._look, self._clock = sidecar, look, clock
        self._guard, self._text, self._until = threading.Lock(), NOTHING, -PERIOD

    def text(self) -> str:
        """Say all there is to know now, as JSON; the last answer where tools hang."""
        if not self._guard.acquire(timeout=PERIOD):
            return self._text
        try:
            if self._clock() >= self._until:
                self._text = self._ask()
                self._until = self._clock() + PERIOD
            return self._text
        finally:
            self._guard.release()

    def _ask(self) -> str:
        told, peer = self._sidecar.told(), self._sidecar.peer
        if told is None or peer is None:
            return NOTHING
        return write_told(replace(told, near=self._look(peer[0])))
