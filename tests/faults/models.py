# SPDX-License-Identifier: Apache-2.0

"""Simulate processes, clocks and teleop in virtual time, so that faults can be injected."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import TypeAlias

from cloudrc.flight.pod.teleop_link import PERIOD_NS, RemoteTeleop, TeleopLoop, UnixPeer
from cloudrc.flight.virtual.faults import RestartableEndpoint
from cloudrc.flight.virtual.run import Clock
from cloudrc.physics.geometry.fence import Fence
from cloudrc.teleop.refusals import ConflictError, UnavailableError
from cloudrc.teleop.service import MissionService
from cloudrc.teleop.store import MissionRecord, MissionStore, Order, connect
from cloudrc.teleop.wire import ALARM, Message
from cloudrc.wire.endpoint import Endpoint
from cloudrc.wire.messages import NEVER_NS, Datagram
from cloudrc.wire.records import Fault, MissionEvent, Record

CFS_PERIOD = 0.1  # period of the kernel's CPU quota [s]
UNIX_SOCKET_MAX = 11
"""Number of datagrams that a Unix socket can hold: net.unix.max_dgram_qlen, which is 10, plus 1."""

Tamper: TypeAlias = Callable[[bytes, int], list[bytes]]
"""Function that replaces an arriving datagram by others, at a virtual time [ns]."""
Call: TypeAlias = Callable[[MissionService, int], object]
"""Function that calls teleop's API; takes the service and the time on teleop's clock [ns]."""


class FaultyEndpoint(RestartableEndpoint):
    """World or cloud in a process whose datagrams may change, and which may be throttled."""

    def __init__(self, build: Callable[[int], Endpoint], clock: Clock) -> None:
        """Start a process; `build` makes its endpoint, given the time on `clock` [ns]."""
        self.tamper: Tamper | None = None  # changes the datagrams that arrive
        super().__init__(build(clock.at(0)), build, clock)

    def restart(self, down: float) -> None:
        """Kill the process; start a new one after `down` [s]."""
        self.kill()
        self.at(self.now_ns * 1e-9 + down, self.start)

    def throttle(self, start: float, duration: float, share: float) -> None:
        """Throttle the process: it runs for a `share` [1] of each CFS period, then it is stopped.

        The throttling begins at `start` [s] and lasts for `duration` [s].
        """
        stall = (1.0 - share) * CFS_PERIOD
        for n in range(int(duration / CFS_PERIOD)):
            self.at(start + n * CFS_PERIOD, self.freeze, stall)

    def receive_datagram(self, data: Datagram, now_ns: int) -> None:
        """Receive a datagram at `now_ns` [ns]; `tamper`, if set, changes the datagram first."""
        for each in [data] if self.tamper is None else self.tamper(data, now_ns):
            self.pass_on(each, now_ns)


class TwoClouds:
    """An `Endpoint`: two clouds in one process; each of them receives all datagrams.

    Attributes:
        members: The clouds, the first one first.
    """

    def __init__(self, members: list[Endpoint], others: list[Record]) -> None:
        """Run `members`; the records of all but the first are appended to `others`."""
        self.members, self._others = members, others

    def receive_datagram(self, data: Datagram, now_ns: int) -> None:
        """Implement `Endpoint.receive_datagram`."""
        for member in self.members:
            member.receive_datagram(data, now_ns)

    def next_deadline_ns(self) -> int:
        """Implement `Endpoint.next_deadline_ns`."""
        return min(member.next_deadline_ns() for member in self.members)

    def handle_deadline(self, now_ns: int) -> None:
        """Implement `Endpoint.handle_deadline`."""
        for member in self.members:
            if now_ns >= member.next_deadline_ns():
                member.handle_deadline(now_ns)

    def take_datagrams(self) -> list[Datagram]:
        """Return the datagrams of both."""
        return [data for member in self.members for data in member.take_datagrams()]

    def take_records(self) -> list[Record]:
        """Return the records of the first cloud; those of another one go to `others`."""
        records, *others = [member.take_records() for member in self.members]
        for each in others:
            self._others += each
        return records


class _Peer(UnixPeer):
    """Model of a Unix datagram socket that is connected to the socket of another process."""

    def __init__(self, is_open: Callable[[], bool]) -> None:
        self.other, self._is_open = self, is_open
        self.waiting: list[Message | None] = []

    def receive(self) -> list[Message | None]:
        waiting, self.waiting = self.waiting, []
        return waiting

    def send(self, message: Message | None) -> bool:
        """Implement `UnixPeer.send`; return False if the other socket is closed or full."""
        sent = self.other._is_open() and len(self.other.waiting) < UNIX_SOCKET_MAX
        if sent:
            self.other.waiting.append(message)
        return sent


class TeleopModel:
    """Models teleop in a process of its own, with a disk that survives restarts.

    The process wakes every 20 ms. Two Unix sockets connect it with cloud, as in production.

    Attributes:
        service: Teleop's service; None while teleop is not running.
        events: Events of all missions, oldest first.
    """

    _host: FaultyEndpoint  # the machine of cloud, from `run_on` on

    def __init__(self, fence: Fence, phase_ns: int) -> None:
        """Start teleop.

        Args:
            fence: Fence of the scene.
            phase_ns: Time at which teleop's process wakes for the first time [ns, virtual time].
        """
        self._fence = fence
        self._phase_ns, self._starts = phase_ns, 0
        self._disk = connect()  # each change of the store is one transaction
        self.events: list[MissionEvent] = []
        self._peer = _Peer(lambda: self.service is not None)
        self._clouds = _Peer(lambda: self._host.inner is not None)
        self._peer.other, self._clouds.other = self._clouds, self._peer
        self.start()

    def start(self) -> None:
        """Start a new process, which knows only what is on the disk."""
        self._starts += 1
        salt = b"desk %d" % self._starts  # random in production
        service = MissionService(MissionStore(self._disk, salt), self._fence)
        self.service: MissionService | None = service
        self._peer.waiting.clear()
        self._calls, self._stops = list[Call](), list[Call]()
        self._loop = TeleopLoop(
            service,
            self._peer,
            self._take,
            calls=partial(_make, service, self._calls),
            stops=partial(_make, service, self._stops),
        )
        self._free_ns, self._turn_ns = 0, NEVER_NS

    def kill(self) -> None:
        """Kill the process; only the disk remains."""
        self.service = None

    def run_on(self, host: FaultyEndpoint) -> None:
        """Run teleop on the machine of the cloud `host`; teleop also runs while cloud is down."""
        self._host = host
        host.at(self._phase_ns * 1e-9, self._wake)

    def join(self, start_ns: int) -> RemoteTeleop:
        """Connect a cloud that starts at `start_ns` on its clock [ns]; return its `Operator`."""
        self._clouds.waiting.clear()  # lost with the previous cloud
        return RemoteTeleop(self._clouds, start_ns)

    @property
    def missions(self) -> list[MissionRecord]:
        """All missions, oldest first; none while teleop is not running."""
        return list(self.service.book.missions.values()) if self.service is not None else []

    def order(self, order: Order, now_ns: int) -> None:
        """Order a mission at `now_ns` on cloud's clock [ns]; it starts at once."""
        assert self.service is not None, "teleop is down"
        self.service.create(order, now_ns)

    def ask(self, call: Call) -> None:
        """Call teleop's API; teleop handles the call when it wakes next. A refusal is ignored."""
        self._calls.append(call)

    def switch_off(self) -> None:
        """Make an emergency stop: teleop sends `ALARM` to cloud at once.

        When teleop's process wakes next, it also stores the stop on the disk.
        """
        if self.service is not None:
            self._stops.append(MissionService.switch_off)
            self._peer.send(ALARM)

    def freeze(self, duration: float) -> None:
        """Freeze the process as with SIGSTOP for `duration` [s]."""
        if self.service is not None:
            self._free_ns = max(self._free_ns, self._host.now_ns + round(duration * 1e9))
            self._host.at(self._free_ns * 1e-9, self._turn)  # a late process wakes at once

    def _take(self, news: list[MissionEvent | Fault]) -> None:
        self.events += [each for each in news if isinstance(each, MissionEvent)]

    def _wake(self) -> None:
        self._turn()
        self._host.at((self._host.now_ns + PERIOD_NS) * 1e-9, self._wake)

    def _turn(self) -> None:
        now_ns = self._host.now_ns
        if self.service is None or now_ns < self._free_ns:
            return
        late_ns = max(0, now_ns - self._turn_ns - PERIOD_NS) if self._turn_ns >= 0 else 0
        self._turn_ns = now_ns
        self._loop.wake(self._host.clock.at(now_ns), late_ns)


def _make(service: MissionService, calls: list[Call], now_ns: int) -> None:
    while calls:
        with suppress(ConflictError, UnavailableError):
            calls.pop(0)(service, now_ns)
