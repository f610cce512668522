"""Teleop as a process of its own, in virtual time: it looks now and then, and waits for its disk.

A model of `cloudrc.drivers.teleop.serve_teleop`, joined to the very `RemoteTeleop` of production:

    CloudEndpoint - RemoteTeleop  <- two sockets, 11 datagrams each ->  Apart - MissionService

It looks every 20 ms, obeys the calls of the API, and sees the newest of what waits for it.
While it stands still, for an fsync of its journal or stopped by a signal, nothing is heard or said,
and what its socket has no room for is lost: what waits at the end is of the past, and passed over.
It lives on while cloud is frozen or killed.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from functools import partial
from pathlib import Path

from cloudrc.cloud.operator import Operator
from cloudrc.drivers.teleop import EVENTS_KEPT, PERIOD_NS, RemoteTeleop, UnixPeer, send, turn
from cloudrc.faults.desk import Desk
from cloudrc.faults.mortal import Mortal
from cloudrc.faults.scenario import generator
from cloudrc.faults.schedule import Event
from cloudrc.messages import NEVER_NS
from cloudrc.teleop import wire
from cloudrc.teleop.bridge import WAITING_MAX, Call
from cloudrc.teleop.journal import Entry
from cloudrc.teleop.service import MissionService

SOCKET_MAX = 11
"""Datagrams that wait: one more than net.unix.max_dgram_qlen, which is 10 in a new namespace."""


class Socket:
    """What is bound to a path: datagrams come in and wait, as far as there is room.

    Attributes:
        waiting: Oldest first.
    """

    def __init__(self, there: Callable[[], bool]) -> None:
        """Begin empty; `there` says whether a process has it open."""
        self._there = there
        self.waiting: list[bytes] = []

    def take(self, data: bytes) -> bool:
        """Say whether it is taken."""
        taken = self._there() and len(self.waiting) < SOCKET_MAX
        if taken:
            self.waiting.append(data)
        return taken


class Peer(UnixPeer):
    """One of two processes, as its code knows it."""

    def __init__(self, own: Socket, other: Socket) -> None:
        self.unsent, self._inbox, self._outbox = 0, own, other

    def receive(self) -> list[bytes]:
        """See `UnixPeer`."""
        datagrams, self._inbox.waiting = self._inbox.waiting, []
        return datagrams

    def send(self, data: bytes) -> bool:
        """See `UnixPeer`."""
        sent = self._outbox.take(data)
        self.unsent += not sent
        return sent


class Apart(Desk):
    """A desk that sees and says nothing but in its turns.

    Its entries are kept one fsync after the other: killed meanwhile, it has written those of which
    the fsync had begun. The journal in memory is slow, that in a file never is.

    Attributes:
        slow: While one of these lasts, an fsync of the journal takes its value [s].
    """

    def __init__(
        self, contact_speed_max: float, path: Path | None = None, *, phase_ns: int = 0
    ) -> None:
        """Open for the first time; see `Desk`.

        Args:
            contact_speed_max: Below which the arm's tip may meet the board [m/s].
            path: Of a real journal; None for one in memory.
            phase_ns: Of its turns, below `PERIOD_NS` [ns].
        """
        self._at_teleop = Socket(lambda: self.service is not None)
        self._at_cloud = Socket(lambda: self._host is not None and self._host.inner is not None)
        self._peer = Peer(self._at_teleop, self._at_cloud)
        self._host: Mortal | None = None
        self._phase_ns, self._life, self._free_ns = phase_ns, 0, 0
        self.slow: list[Event] = []
        super().__init__(contact_speed_max, path)

    def start(self) -> None:
        """See `Desk`; nothing waits for a new process."""
        self._forget()
        super().start()

    def kill(self) -> None:
        """See `Desk`; what waited for the end of an fsync is never said."""
        super().kill()
        self._forget()

    def live(self, host: Mortal) -> None:
        """See `Desk`; whatever befalls cloud, the turns go on."""
        self._host = host
        host.at(self._phase_ns * 1e-9, self._tick)

    def join(self, start_ns: int) -> Operator:
        """See `Desk`; what waited for the cloud before is lost with its socket."""
        self._at_cloud.waiting.clear()
        peer = Peer(self._at_cloud, self._at_teleop)
        return RemoteTeleop(peer, wire.encode, wire.decode, start_ns)

    def ask(self, call: Call, now_ns: int) -> None:
        """See `Desk`; it is answered in the next turn, if not too many wait."""
        if self.service is not None and len(self._calls) < WAITING_MAX:
            self._calls.append(call)

    def stop_rotors(self, now_ns: int) -> None:
        """See `Desk`; its alarm goes past teleop's loop, from the thread of the API.

        So it does from a process that stands still, unlike in production.
        """
        if self.service is not None:
            self._stops.append(MissionService.stop_rotors)
            self._peer.send(wire.encode(wire.ALARM))

    def shut_down(self, now_ns: int) -> None:
        """See `Desk`; it is asked for a signal in every turn."""
        self._ends = self.service is not None

    def stop(self, now_ns: int, duration: float) -> None:
        """SIGSTOP.

        Args:
            now_ns: When, virtual time [ns].
            duration: How long [s].
        """
        if self.service is not None:
            self._free_ns = max(self._free_ns, now_ns + round(duration * 1e9))
            self._turn_when_free()

    def _forget(self) -> None:
        self._at_teleop.waiting.clear()
        self._calls: list[Call] = []
        self._stops: list[Call] = []
        self._unsent: deque[bytes] = deque(maxlen=EVENTS_KEPT)
        self._ends, self._free_ns, self._turn_ns = False, 0, NEVER_NS
        self._blind = 0
        self._life += 1

    def _tick(self, now_ns: int) -> None:
        assert self._host is not None
        self._turn(now_ns)
        self._host.at((now_ns + PERIOD_NS) * 1e-9, self._tick)

    def _turn_when_free(self) -> None:
        """Whoever was late looks again at once."""
        assert self._host is not None
        self._host.at(self._free_ns * 1e-9, self._turn)

    def _turn(self, now_ns: int) -> None:
        if self.service is None or self._host is None or now_ns < self._free_ns:
            return
        self._send()  # what has waited for the end of an fsync
        own_ns, turned_ns = self._host.clock.at(now_ns), self._turn_ns
        self._turn_ns = self._free_ns = now_ns
        late_ns = now_ns - turned_ns - PERIOD_NS if turned_ns >= 0 else 0
        self._blind = turn(
            self,
            self._peer,
            wire.decode,
            self._take_calls,
            stops=self._take_stops,
            blind=self._blind,
            late_ns=late_ns,
            now_ns=own_ns,
        )
        if self._free_ns > now_ns:
            self._turn_when_free()
        else:
            self._send()

    def _take_calls(self) -> list[Callable[[int], None]]:
        ask, shut_down = super().ask, super().shut_down
        calls: list[Callable[[int], None]] = [shut_down] if self._ends else []
        calls += [partial(ask, call) for call in self._calls]
        self._calls, self._ends = [], False
        return calls

    def _take_stops(self) -> list[Callable[[int], None]]:
        stops, self._stops = self._stops, []
        return [partial(super(Apart, self).ask, stop) for stop in stops]

    def _send(self) -> None:
        """Say it to cloud: events wait for one that is there, everything else is repeated."""
        send(self.take_outputs(), self._unsent, self._peer, wire.encode)

    def _keep(self, entry: Entry) -> None:
        began_ns, life = self._free_ns, self._life
        takes = (e.value for e in self.slow if e.at <= began_ns * 1e-9 < e.end)
        self._free_ns += round(max(takes, default=0.0) * 1e9)
        if self._host is None or began_ns <= self._turn_ns:
            super()._keep(entry)
            return
        if self.refuse is not None:
            self.refuse()

        def reach(_: int) -> None:
            if self._life == life:
                self.entries.append(entry)

        self._host.at(began_ns * 1e-9, reach)


def apart(contact_speed_max: float, path: Path | None, seed: int) -> Apart:
    """Open a desk whose turns have the phase of a seed.

    Args:
        contact_speed_max: Below which the arm's tip may meet the board [m/s].
        path: Of a real journal; None for one in memory.
        seed: Of the phase.
    """
    phase_ns = int(generator(seed, 45).integers(PERIOD_NS))
    return Apart(contact_speed_max, path, phase_ns=phase_ns)
