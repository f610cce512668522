"""The operator's desk in virtual time: teleop's service with its journal, which may die and return.

Cloud's end is joined to it as it is to the process of teleop: while that is away, nobody answers.
It sees and says everything at once, as long as cloud asks it to; see `Apart` for one that does not.

An end of the tunnel that can be killed, frozen and replaced, whose clock may be another.

It is an `Endpoint` itself: the driver of virtual time does not know what befalls the end inside.
Whatever is to happen to it is scheduled, and happens at its very nanosecond.

Teleop as a process of its own, in virtual time: it looks now and then, and waits for its disk.

A model of `cloudrc.drivers.teleop.serve_teleop`, joined to the very `RemoteTeleop` of production:

    CloudEndpoint - RemoteTeleop  <- two sockets, 11 datagrams each ->  Apart - MissionService

It looks every 20 ms, obeys the calls of the API, and sees the newest of what waits for it.
While it stands still, for an fsync of its journal or stopped by a signal, nothing is heard or said,
and what its socket has no room for is lost: what waits at the end is of the past, and passed over.
It lives on while cloud is frozen or killed.
"""

from __future__ import annotations

import sqlite3
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from heapq import heappop, heappush
from pathlib import Path
from typing import Any

from cloudrc.cloud.operator import Operator
from cloudrc.drivers.teleop import EVENTS_KEPT, PERIOD_NS, RemoteTeleop, UnixPeer, send, turn
from cloudrc.endpoint import Endpoint
from cloudrc.faults.scenario import generator
from cloudrc.faults.schedule import Event
from cloudrc.messages import NEVER_NS
from cloudrc.records import Fault, Lateness, MissionEvent, Record
from cloudrc.teleop import wire
from cloudrc.teleop.bridge import WAITING_MAX, Call
from cloudrc.teleop.service import MissionService
from cloudrc.teleop.store import (
    ConflictError,
    Mission,
    MissionStore,
    Order,
    UnavailableError,
    connect,
    open_store,
)
from cloudrc.teleop.wire import Outcome, Output, Plan, RobotStatus

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


class Database(sqlite3.Connection):
    """A database whose commits a scenario sees.

    Attributes:
        before: Called before a commit; an `sqlite3.OperationalError` refuses it.
        after: Called after a commit.
    """

    before: Callable[[], None] | None = None
    after: Callable[[], None] | None = None

    def commit(self) -> None:
        """See `sqlite3.Connection`."""
        if self.before is not None:
            self.before()
        super().commit()
        if self.after is not None:
            self.after()


class Desk:
    """What cloud's end has for an operator.

    Attributes:
        service: The one that lives now; None while teleop is down.
        image: What the store holds, in memory: the bytes of its database.
        events: All that has happened to missions, oldest first.
        refuse: If set, it is called before a commit; a full disk raises sqlite3.OperationalError.
    """

    outcome: Outcome | None = None
    settled = True

    def __init__(
        self, contact_speed_max: float, path: Path | None = None, name: bytes = b"desk"
    ) -> None:
        """Open for the first time.

        Args:
            contact_speed_max: Below which the arm's tip may meet the board [m/s].
            name: Tells its missions from those of another desk.
            path: Of a real store; None for one in memory that never fails.
        """
        self._contact_speed_max, self._path, self._name = contact_speed_max, path, name
        self._database: Database | None = None
        self._started = 0
        self.image, self.image_before = b"", b""
        self.events: list[MissionEvent] = []
        self.refuse: Callable[[], None] | None = None
        self.service: MissionService | None = None
        self._outputs: list[Output | Fault] = []
        self.start()

    def start(self) -> None:
        """A new process, which has nothing but the store."""
        self._started += 1
        salt = b"%s %d" % (self._name, self._started)  # in production it is random
        if self._path is not None:
            book = open_store(self._path, salt, self._open)
        else:
            connection = connect(None, self._open)
            if self.image:
                connection.deserialize(self.image)
            book = MissionStore(connection, salt)
        assert self._database is not None
        self._database.before, self._database.after = self._refuse, self._keep
        self.service = MissionService(self._contact_speed_max, book)

    def kill(self) -> None:
        """Teleop is gone, and what it had not written down with it."""
        if self._database is not None:
            self._database.close()
        self.service = self._database = None
        self._outputs.clear()

    @property
    def entries(self) -> list[dict[str, Any]]:
        """Events that the disk holds, oldest first."""
        if self.service is not None and self._path is not None:
            return self.service.book.events_after(0)
        connection = connect(self._path)
        if self.image:
            connection.deserialize(self.image)
        events = MissionStore(connection, b"").events_after(0)
        connection.close()
        return events

    def order(self, plan: Plan, now_ns: int, **options: Any) -> Mission:
        """Post a mission; it is started at once."""
        assert self.service is not None, "teleop is down"
        mission, _ = self.service.create(Order(plan, **options), now_ns)
        return mission

    def ask(self, call: Call, now_ns: int) -> None:
        """Have a call of the API made on cloud's clock [ns]; what it refuses is dropped."""
        if self.service is not None:
            with suppress(ConflictError, UnavailableError):
                call(self.service, now_ns)

    def stop_rotors(self, now_ns: int) -> None:
        """An emergency stop by the API at an instant [ns] of cloud's clock."""
        self.ask(MissionService.stop_rotors, now_ns)

    def shut_down(self, now_ns: int) -> None:
        """SIGTERM at an instant [ns] of cloud's clock."""
        if self.service is not None:
            self.service.pause(now_ns)

    def live(self, host: Mortal) -> None:
        """Time begins on the machine of cloud, which is teleop's, too."""

    def join(self, start_ns: int) -> Operator:
        """Give a new cloud, born at an instant [ns] of its clock, what it has for teleop."""
        return self

    @property
    def missions(self) -> list[Mission]:
        """All that the service knows, oldest first; none while it is down."""
        return list(self.service.book.missions.values()) if self.service is not None else []

    @property
    def last(self) -> Mission:
        """The mission ordered last."""
        return self.missions[-1]

    # What cloud's end knows of it.

    @property
    def outputs(self) -> Sequence[Output | Fault]:
        """See `cloudrc.cloud.operator.Operator`."""
        return self._outputs

    def hear(self, now_ns: int) -> None:
        """Take note that cloud lives."""
        if self.service is not None:
            self.service.hear(now_ns)

    def see(self, seen: RobotStatus, now_ns: int) -> None:
        """See `cloudrc.cloud.operator.Operator`."""
        if self.service is not None:
            self.service.see(seen, now_ns)
            self._collect()

    def handle_deadline(self, now_ns: int) -> None:
        """See `cloudrc.cloud.operator.Operator`."""
        if self.service is not None:
            self.service.handle_deadline(now_ns)
            self._collect()

    def take_outputs(self) -> Sequence[Output | Fault]:
        """See `cloudrc.cloud.operator.Operator`."""
        outputs, self._outputs = self._outputs, []
        return outputs

    def _collect(self) -> None:
        assert self.service is not None
        outputs = self.service.take_outputs()
        self.events += [said for said in outputs if isinstance(said, MissionEvent)]
        self._outputs += outputs

    def _open(self, *words: Any, **options: Any) -> Database:
        self._database = Database(*words, **options)
        return self._database

    def _refuse(self) -> None:
        if self.refuse is not None:
            self.refuse()

    def _keep(self) -> None:
        """Something is on the disk."""
        if self._path is None and self._database is not None:
            self._hold(self._database.serialize())

    def _hold(self, image: bytes) -> None:
        self.image_before, self.image = self.image, image


UNIX_SOCKET_MAX = 11
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
        taken = self._there() and len(self.waiting) < UNIX_SOCKET_MAX
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
        self._phase_ns, self._life, self._free_ns, self._began_ns = phase_ns, 0, 0, 0
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

    def _refuse(self) -> None:
        began_ns = self._free_ns
        takes = (e.value for e in self.slow if e.at <= began_ns * 1e-9 < e.end)
        self._free_ns += round(max(takes, default=0.0) * 1e9)
        self._began_ns = began_ns
        super()._refuse()

    def _hold(self, image: bytes) -> None:
        life, began_ns = self._life, self._began_ns
        if self._host is None or began_ns <= self._turn_ns:
            super()._hold(image)
            return

        def reach(_: int) -> None:
            if self._life == life:
                super(Apart, self)._hold(image)

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
