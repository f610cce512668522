"""An end of the tunnel that can be killed, frozen and replaced, whose clock may be another.

It is an `Endpoint` itself: the driver of virtual time does not know what befalls the end inside.
Whatever is to happen to it is scheduled, and happens at its very nanosecond.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from heapq import heappop, heappush

from cloudrc.endpoint import Endpoint
from cloudrc.records import Lateness, Record

FAR_NS = 1 << 62
CFS_PERIOD = 0.1
"""Of the kernel's CPU quota [s]."""
SOCKET_MAX = 256
"""Datagrams that wait in the socket of a process that stands still; Linux' default buffer."""

Action = Callable[[int], None]
"""Something that happens at an instant [ns, virtual time]."""
Tamper = Callable[[bytes, int], list[bytes]]
"""What arrives in place of a datagram at an instant [ns]."""


@dataclass(frozen=True, slots=True)
class Clock:
    """A monotonic clock beside virtual time.

    Attributes:
        offset_ns: What it shows at virtual time 0 [ns].
        drift_ppm: By how much it is fast [ppm], a whole number.
    """

    offset_ns: int = 0
    drift_ppm: int = 0

    def at(self, now_ns: int) -> int:
        """What it shows at `now_ns` of virtual time [ns]."""
        if not self.drift_ppm:
            return now_ns + self.offset_ns
        return now_ns + self.offset_ns + now_ns * self.drift_ppm // 1_000_000

    def when(self, shown_ns: int) -> int:
        """First instant of virtual time [ns] at which it shows at least `shown_ns` [ns]."""
        if not self.drift_ppm:
            return shown_ns - self.offset_ns
        elapsed_ns = shown_ns - self.offset_ns
        now_ns = elapsed_ns * 1_000_000 // (1_000_000 + self.drift_ppm) - 1
        while self.at(now_ns) < shown_ns:
            now_ns += 1
        return now_ns


class Mortal:
    """World or cloud, at the mercy of a scenario.

    Attributes:
        inner: The end that lives now; None while there is none.
        tamper: What becomes of a datagram before it gets in; None leaves it alone.
        clock: Its own.
        lost: Datagrams that found no process.
    """

    def __init__(self, build: Callable[[int], Endpoint], clock: Clock, name: str = "world") -> None:
        """Bring the first one up at once.

        Args:
            build: Makes an end that is born at an instant [ns] of its own clock.
            clock: Its own.
            name: "world" or "cloud", for the records.
        """
        self._build, self.clock, self._name = build, clock, name
        self.tamper: Tamper | None = None
        self.lost = 0
        self._frozen_until_ns = -1
        self._waiting: list[bytes] = []
        self._left: list[Record] = []
        self._to_send: list[bytes] = []
        self._actions: list[tuple[int, int, Action]] = []
        self._scheduled = 0
        self.inner: Endpoint | None = build(clock.at(0))
        self._due_ns = FAR_NS
        self._look()

    def at(self, seconds: float, action: Action) -> None:
        """Have something happen.

        Args:
            seconds: Instant of virtual time [s].
            action: What.
        """
        self._scheduled += 1
        heappush(self._actions, (round(seconds * 1e9), self._scheduled, action))
        self._look()

    def kill(self, now_ns: int) -> None:
        """SIGKILL: memory and socket are gone, what was recorded until now is kept."""
        if self.inner is not None:
            self._left += self.inner.take_records()
        self.inner, self._waiting, self._frozen_until_ns = None, [], -1
        self._look()

    def start(self, now_ns: int) -> None:
        """A new process takes the place of one that was killed."""
        self.inner = self._build(self.clock.at(now_ns))
        self._look()

    def freeze(self, now_ns: int, duration: float) -> None:
        """SIGSTOP: what arrives waits in the socket.

        Args:
            now_ns: When [ns].
            duration: How long [s].
        """
        self._frozen_until_ns = max(self._frozen_until_ns, now_ns + round(duration * 1e9))
        self._look()

    def throttle(self, start: float, duration: float, share: float) -> None:
        """Let it run for a part of every CFS period only.

        Args:
            start: From this instant of virtual time on [s].
            duration: How long [s].
            share: In which it runs, in [0, 1].
        """
        stall = (1.0 - share) * CFS_PERIOD
        for n in range(int(duration / CFS_PERIOD)):
            self.at(start + n * CFS_PERIOD, lambda now_ns: self.freeze(now_ns, stall))

    def receive_now(self, data: bytes, now_ns: int) -> None:
        """Hand over a datagram that somebody else has sent."""
        if self.inner is None:
            self.lost += 1
        elif self._frozen_until_ns > now_ns:
            if len(self._waiting) < SOCKET_MAX:
                self._waiting.append(data)
            else:
                self.lost += 1
        else:
            self.inner.receive_datagram(data, self.clock.at(now_ns))

    # The contract of an endpoint.

    @property
    def sealed(self) -> bool:
        """See `Endpoint`."""
        return self.inner is None or self.inner.sealed

    def receive_datagram(self, data: bytes, now_ns: int) -> None:
        """See `Endpoint`."""
        if self.tamper is None:
            self.receive_now(data, now_ns)
        else:
            for each in self.tamper(data, now_ns):
                self.receive_now(each, now_ns)
        self._look()

    def next_deadline_ns(self) -> int:
        """See `Endpoint`."""
        return self._due_ns

    def handle_deadline(self, now_ns: int) -> None:
        """See `Endpoint`."""
        while self._actions and self._actions[0][0] <= now_ns:
            heappop(self._actions)[2](now_ns)
        inner = self.inner
        was_due_ns = inner.next_deadline_ns() if inner is not None else FAR_NS
        if 0 <= self._frozen_until_ns <= now_ns:
            self._frozen_until_ns = -1
            waiting, self._waiting = self._waiting, []
            for data in waiting:
                self.receive_now(data, now_ns)
        if inner is not None and self._frozen_until_ns < 0:
            own_ns = self.clock.at(now_ns)
            if own_ns >= inner.next_deadline_ns():
                inner.handle_deadline(own_ns)
            if own_ns > was_due_ns + 1000:  # a clock that drifts is off by a nanosecond
                self._note_late_wake(inner, own_ns, own_ns - was_due_ns)
        self._look()

    def take_datagrams(self) -> list[bytes]:
        """See `Endpoint`."""
        if self.inner is None or self._frozen_until_ns >= 0:
            return []
        return self.inner.take_datagrams()

    def take_records(self) -> list[Record]:
        """See `Endpoint`."""
        left, self._left = self._left, []
        return left + self.inner.take_records() if self.inner is not None else left

    def _note_late_wake(self, inner: Endpoint, own_ns: int, late_ns: int) -> None:
        """As the driver of real time does with every wake; in virtual time only these are late."""
        slip_ns = getattr(inner, "slip_ns", 0)
        self._left += inner.take_records()
        self._left.append(Lateness(own_ns - slip_ns, self._name, late_ns * 1e-9, 0.0, slip_ns))

    def _look(self) -> None:
        """When something is due next."""
        due_ns = self._actions[0][0] if self._actions else FAR_NS
        if self.inner is not None:
            if self._frozen_until_ns >= 0:
                due_ns = min(due_ns, self._frozen_until_ns)
            else:
                due_ns = min(due_ns, self.clock.when(self.inner.next_deadline_ns()))
        self._due_ns = due_ns
