"""The link in real time, both ways: datagrams come in and go out when the model says so.

    world <-> [world side]  Relay  [cloud side] <-> cloud

Local mode runs it; in a pod each direction has a sidecar of its own (`relay_shaper`).

One way through the link in real time: from one UDP socket, through the model, to another.

The relay of local mode has two lanes, the relay of a pod's sidecar one. A datagram is due when the
kernel received it plus the delay that the model draws, however long it waited for this process, and
never leaves before.

What a relay's process asks of the machine, so that it runs when a datagram is due.

Lanes that share one thread and one wait: what a relay does from wake to wake.

It sleeps until shortly before the next datagram is due, looks at the clock until it is, sends what
is due, and only then takes in what has come: that has its kernel's stamp and can wait. Where every
delay is long it is not even woken by what comes, but looks in time: half the wakes, which cost more
than all else.

The relay of a pod's sidecar: what the pod sends comes in, delayed as asked it goes to the peer.

tunnel end > [listen]  RelayShaper  [any port] > the other pod's tunnel end
"""

from __future__ import annotations

import gc
import heapq
import os
import socket
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from itertools import count
from time import monotonic_ns, sleep
from typing import TypeAlias

from cloudrc.link.lateness import Lead, Recent, ReleaseErrors, in_ns
from cloudrc.link.model import LinkDirection
from cloudrc.link.profile import DirectionProfile
from cloudrc.link.relay_io import (
    AGE_MAX_NS,
    ANCILLARY_SIZE,
    Received,
    Receiver,
    Sender,
    Stamps,
    Wait,
    ask_for_stamps,
    available,
    best_wait,
    instant_ns,
    tighten_slack,
)

Address: TypeAlias = tuple[str, int]
Peek: TypeAlias = Callable[[bytes], tuple[int, int, int]]
"""Kind, epoch and counter of a datagram; raises ValueError if it is not one of ours."""

IN_FLIGHT_MAX = 10_000
"""Datagrams that a lane holds at once, unless told otherwise."""
DATAGRAM_MAX = 2_048
"""Longer ones are malformed, so that what a lane holds is bounded in bytes, too."""

_FEW = 4
"""Datagrams that are read one by one, where they cannot be read with one call."""
_BATCH = 32
"""Datagrams taken in or released with one call."""
_TOO_LONG = int(socket.MSG_TRUNC)
_ROUNDS = 3
"""Batches taken in or released on one side before the other has its turn."""


class Side:
    """One side of a lane: its socket, which stays its owner's to close, and who is there.

    Attributes:
        stamped: Whether the kernel notes when a datagram came, so that it may wait to be read.
    """

    def __init__(self, own: socket.socket, peer: Address | None = None) -> None:
        own.setblocking(False)
        self.stamped = ask_for_stamps(own)
        self.socket = own
        self.peer = peer
        batches = available()
        self.receiver = Receiver(own, _BATCH, DATAGRAM_MAX) if batches else None
        self.sender = Sender(own, _BATCH, DATAGRAM_MAX) if batches else None


class Lane:
    """Takes datagrams in at one side, asks the model, and sends them from the other when due.

    Attributes:
        origin_ns: What the model counts time from [ns], monotonic clock; None: from the first
            datagram.
        errors: How late datagrams have left.
    """

    def __init__(
        self,
        source: Side,
        target: Side,
        direction: LinkDirection,
        peek: Peek,
        in_flight_max: int = IN_FLIGHT_MAX,
    ) -> None:
        """Set up.

        Args:
            source: Where datagrams arrive; its peer, if unknown, is whom the first valid one is
                from.
            target: Where they leave for `target.peer`, which may change in flight.
            direction: The link between the two.
            peek: Reads kind, epoch and counter of a datagram.
            in_flight_max: Datagrams held at once; what comes on top is dropped and counted.
        """
        self.source = source
        self.target = target
        self.direction = direction
        self.origin_ns: int | None = None
        self.errors = ReleaseErrors()
        self._peek = peek
        self._in_flight_max = in_flight_max
        # Due instant [ns], a number that keeps equal instants in order, data.
        self._in_flight: list[tuple[int, int, bytes]] = []
        self._numbers = count()
        self._stamps = Stamps()
        self._received = self._forwarded = self._lost = 0
        self._malformed = self._overflow = self._unsent = self._stalled = 0

    def due_ns(self) -> int | None:
        """Say when the next datagram is to leave [ns], monotonic clock; None if none is held."""
        return self._in_flight[0][0] if self._in_flight else None

    @property
    def patience_ns(self) -> int:
        """For so long at most a datagram waits for this lane until it has to be due [ns]."""
        return self.direction.least_delay_ns if self.source.stamped else 0

    def take_in(self) -> int:
        """Put what waits in the source's socket on the link; say how many datagrams that were."""
        offset_ns = self._stamps.look_at_clocks()
        receiver, taken = self.source.receiver, 0
        if receiver is None or self.source.peer is None:
            few = self._read_few()
            self._put_on_link(few, offset_ns)
            return len(few)
        for _ in range(_ROUNDS):
            batch = receiver.receive()
            self._put_on_link(batch, offset_ns)
            taken += len(batch)
            if len(batch) < _BATCH:
                break
        return taken

    def release(self) -> None:
        """Send what is due."""
        in_flight, target, now_ns = self._in_flight, self.target, monotonic_ns()
        for _ in range(_ROUNDS):
            if not in_flight or in_flight[0][0] > now_ns:
                return
            due_ns, _, data = heapq.heappop(in_flight)
            self._send(due_ns, data, now_ns)
            if target.sender and target.peer and in_flight and in_flight[0][0] <= now_ns:
                self._release_batch(target.sender, target.peer, now_ns)
            now_ns = monotonic_ns()

    def counts(self) -> dict[str, int]:
        """Say what has happened to datagrams so far; `Lanes.outcomes` explains the names."""
        return {
            "received": self._received,
            "forwarded": self._forwarded,
            "lost": self._lost,
            "malformed": self._malformed,
            "overflow": self._overflow,
            "unread": self._stamps.dropped,
            "unsent": self._unsent,
        }

    def released(self) -> dict[str, int]:
        """Say how late datagrams left since the beginning, and what the errors do not tell.

        As `lateness.in_ns`; `overflow`: how many had no room here; `stalled`: how many waited
        for this process for 50 ms or more, and may have waited for longer than is known: they left
        later than their errors say. Empty before the first. Any thread may ask.
        """
        told = in_ns(self.errors)
        return {**told, "overflow": self._overflow, "stalled": self._stalled} if told else {}

    def _read_few(self) -> list[Received]:
        """Read what waits, one by one and not for long."""
        read, source, found = self._stamps.wall_ns, self.source, list[Received]()
        for _ in range(_FEW):
            try:
                data, beside, flags, address = source.socket.recvmsg(DATAGRAM_MAX, ANCILLARY_SIZE)
            except OSError:  # Nothing left, or the kernel reports that a peer is not there yet.
                break
            whole = not flags & _TOO_LONG
            found.append((data if whole else None, read(beside), None))
            if source.peer is None and whole and self._is_ours(data):
                source.peer = address
        return found

    def _put_on_link(self, batch: Sequence[Received], offset_ns: int | None) -> None:
        """Draw what becomes of datagrams, and hold what is to leave."""
        now_ns, peek, direction = monotonic_ns(), self._peek, self.direction
        in_flight, numbers, push = self._in_flight, self._numbers, heapq.heappush
        self._received += len(batch)
        for data, wall_ns, dropped in batch:
            if dropped is not None:
                self._stamps.learn_dropped(dropped)
            try:
                if data is None:
                    raise ValueError
                kind, epoch, counter = peek(data)
            except ValueError:
                self._malformed += 1
                continue
            received_ns = instant_ns(wall_ns, offset_ns, now_ns)
            if now_ns - received_ns >= AGE_MAX_NS:
                self._stalled += 1
            origin_ns = self.origin_ns
            if origin_ns is None:
                origin_ns = self.origin_ns = received_ns
            size = len(data)
            releases = direction.send(epoch, kind, counter, size, received_ns - origin_ns)
            if not releases:
                self._lost += 1
            elif direction.corrupts:
                data = direction.corrupted(epoch, kind, counter, data)
            for release_ns in releases:
                if len(in_flight) >= self._in_flight_max:
                    self._overflow += 1
                else:
                    push(in_flight, (release_ns + origin_ns, next(numbers), data))

    def _is_ours(self, data: bytes) -> bool:
        try:
            self._peek(data)
        except ValueError:
            return False
        return True

    def _release_batch(self, sender: Sender, peer: Address, now_ns: int) -> None:
        """Send with one call what else is due at `now_ns`."""
        in_flight = self._in_flight
        batch: list[tuple[int, int, bytes]] = []
        while in_flight and in_flight[0][0] <= now_ns and len(batch) < _BATCH:
            batch.append(heapq.heappop(in_flight))
        begun_ns = monotonic_ns()
        sent = sender.send([data for _, _, data in batch], peer)
        self._forwarded += sent
        # The kernel takes equally long for each.
        each_ns, observe = (monotonic_ns() - begun_ns) // max(sent, 1), self.errors.observe
        for due_ns, _, _ in batch[:sent]:
            observe(begun_ns - due_ns)
            begun_ns += each_ns
        for due_ns, _, data in batch[sent:]:
            self._send(due_ns, data, monotonic_ns())

    def _send(self, due_ns: int, data: bytes, now_ns: int) -> None:
        """Send one that is due at `now_ns`."""
        target = self.target
        try:
            if target.peer is None:
                raise OSError
            target.socket.sendto(data, target.peer)
        except OSError:
            self._unsent += 1
        else:
            self._forwarded += 1
            self.errors.observe(now_ns - due_ns)


_FIFO_PRIORITY = 10
"""Above every ordinary process, below the kernel's own threads (50)."""
_SWITCH_INTERVAL = 0.0002
_COLLECT_AFTER = 50_000
"""Objects in flight are no garbage: the collector need not look at them so often."""


def settle() -> None:
    """Keep what is loaded from the collector's eyes, and other threads from holding this one up.

    A thread that answers Prometheus keeps the interpreter for at most 0.2 ms, not Python's 5 ms.
    """
    sys.setswitchinterval(_SWITCH_INTERVAL)
    gc.collect()
    gc.freeze()
    gc.set_threshold(_COLLECT_AFTER)


def ask_for_fifo() -> str:
    """Let the calling thread run before every ordinary one, if it may.

    Threads and processes that it starts are ordinary again.

    Returns:
        "" if it does, else why it does not.
    """
    if not hasattr(os, "SCHED_FIFO"):
        return "this system has no SCHED_FIFO"
    try:
        policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
        os.sched_setscheduler(0, policy, os.sched_param(_FIFO_PRIORITY))
    except OSError as error:
        return f"{error.strerror}; it takes CAP_SYS_NICE or a limit on rtprio"
    return ""


def runs_first() -> bool:
    """Say whether the calling thread runs before every ordinary one."""
    if not hasattr(os, "SCHED_FIFO"):
        return False
    return os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO


_DEFER_NS = 60_000
"""So shortly before it has to wake for a release a relay does not begin to take in [ns]."""
_SLACK_NS = 2_000_000
"""By so much it looks sooner than it has to, so that what it does then is done in time [ns]."""
_UNWATCHED_MIN_NS = 2_000_000
_UNWATCHED_MAX_NS = 20_000_000
"""Shortest and longest time for which it is not woken by what comes [ns]. The longest is well below
`relay_io.AGE_MAX_NS`, and a socket of usual size takes 10,000 datagrams a second meanwhile."""
_TAKING_NS = 300_000
"""What taking in a few may take [ns]: if a datagram is due before, that leaves first."""
_AT_ONCE_MAX = 6
"""If more datagrams than this have come at once it is woken by each, for a second."""
_WATCH_NS = 1_000_000_000


class Lanes:
    """Lanes that share one thread and one wait."""

    def __init__(self, lanes: Sequence[Lane], origin_ns: int | None) -> None:
        """Set up.

        Args:
            lanes: At least one.
            origin_ns: What their models count time from [ns], on the machine's monotonic clock;
                None: from the first datagram, as in virtual time, whatever it takes to start.
        """
        self._lanes = tuple(lanes)
        self._sources = tuple(lane.source.socket.fileno() for lane in self._lanes)
        self._looked_ns = self._watched_ns = 0
        self._lead = Lead(first=runs_first())
        self._recent = Recent()
        self._wait: Wait = best_wait([lane.source.socket for lane in self._lanes])
        self._origin_known = False
        self._tell_origin(origin_ns)

    def step(self, timeout: float) -> None:
        """Wait for a datagram or a due instant, at most `timeout` [s], and handle what is there."""
        due_ns = self._due_ns()
        if due_ns is None:
            self._take_in(tuple(self._wait.until(None, timeout)))
            return
        patience_ns = self._patience_ns(monotonic_ns())
        if patience_ns:
            self._step_unwatched(due_ns, self._looked_ns + patience_ns)
            return
        readable = self._sleep(due_ns, timeout)
        self._release()
        self._take_in(readable)

    def _step_unwatched(self, due_ns: int, look_ns: int) -> None:
        """Release what is due next, or look at the sockets, which is to be done by `look_ns`."""
        now_ns = monotonic_ns()
        if due_ns < max(look_ns, now_ns) + _TAKING_NS:
            self._sleep_unwatched(due_ns)
            self._release()
            next_ns = self._due_ns()
            if next_ns is None or next_ns < max(look_ns, monotonic_ns()) + _TAKING_NS:
                return  # there is a wake before the look has to be, or nothing under way
        elif now_ns < look_ns:
            sleep((look_ns - now_ns) * 1e-9)
        self.take_in()

    def _due_ns(self) -> int | None:
        dues_ns = [due_ns for lane in self._lanes if (due_ns := lane.due_ns()) is not None]
        return min(dues_ns) if dues_ns else None

    def run(self, timeout: float) -> None:
        """Step for `timeout` [s], or a little longer."""
        until_ns = monotonic_ns() + round(timeout * 1e9)
        while (rest_ns := until_ns - monotonic_ns()) > 0:
            self.step(rest_ns * 1e-9)

    def take_in(self) -> None:
        """Put on the link whatever has come."""
        self._take_in(self._sources)

    def close(self) -> None:
        """Give back what the wait needs; the sockets stay their owners' to close."""
        self._wait.close()

    def outcomes(self) -> dict[str, int]:
        """Count the datagrams of all lanes by what became of them.

        `received`; `lost` on the link by any cause; `malformed`; `overflow` beyond
        `in_flight_max`; `unread` because the kernel had no room for them in the socket (it tells
        so with the next one that it has room for); `unsent` because the other end is unknown or
        the kernel refused; `forwarded`, copies included.
        """
        outcomes: Counter[str] = Counter()
        for lane in self._lanes:
            outcomes.update(lane.counts())
        return dict(outcomes)

    def recent(self) -> dict[str, int]:
        """Say how late datagrams left of late, as `Recent.counts`; to be asked once a second."""
        return self._recent.counts(self._errors())

    def counts(self) -> dict[str, float]:
        """Say what has happened so far, on all lanes together.

        `outcomes`, `released_early`, and `release_error_p50`, `_p99` and `_p999`: how late
        datagrams left since the beginning [s]; absent before the first.
        """
        errors = self._errors()
        return {**self.outcomes(), "released_early": errors.early, **errors.quantiles()}

    def _errors(self) -> ReleaseErrors:
        return ReleaseErrors.together(lane.errors for lane in self._lanes)

    def _patience_ns(self, now_ns: int) -> int:
        """Say for how long nobody need be woken by what comes [ns]; 0: not even shortly."""
        if now_ns < self._watched_ns:
            return 0
        patience_ns = min([lane.patience_ns for lane in self._lanes]) - _SLACK_NS
        return min(patience_ns, _UNWATCHED_MAX_NS) if patience_ns > _UNWATCHED_MIN_NS else 0

    def _release(self) -> None:
        for lane in self._lanes:
            lane.release()

    def _take_in(self, readable: Sequence[int]) -> None:
        """Take in what waits in these sockets."""
        self._looked_ns = monotonic_ns()
        for lane, source in zip(self._lanes, self._sources, strict=True):
            if source in readable:
                if lane.take_in() > _AT_ONCE_MAX:
                    self._watched_ns = self._looked_ns + _WATCH_NS
                if not self._origin_known:
                    self._tell_origin(lane.origin_ns)
                lane.release()  # where there is no delay

    def _sleep(self, due_ns: int, timeout: float) -> Sequence[int]:
        """Sleep until a socket can be read, or until a datagram is due."""
        wake_ns = due_ns - self._lead.ahead_ns()
        asleep_ns = monotonic_ns()
        readable = tuple(self._wait.until(wake_ns, timeout))
        now_ns = monotonic_ns()
        if now_ns < wake_ns - _DEFER_NS:
            return readable
        if now_ns < wake_ns:
            # What has come has its stamp: to take it in now could make the other one late.
            sleep((wake_ns - now_ns) * 1e-9)
            now_ns = monotonic_ns()
        if asleep_ns < wake_ns and not readable:
            self._lead.woke(now_ns - wake_ns)
        self._spin(wake_ns, due_ns, now_ns)
        return readable

    def _sleep_unwatched(self, due_ns: int) -> None:
        """Sleep until a datagram is due, whatever comes."""
        wake_ns = due_ns - self._lead.ahead_ns()
        now_ns = monotonic_ns()
        if now_ns < wake_ns:
            sleep((wake_ns - now_ns) * 1e-9)
            now_ns = monotonic_ns()
            self._lead.woke(now_ns - wake_ns)
        self._spin(wake_ns, due_ns, now_ns)

    def _spin(self, wake_ns: int, due_ns: int, now_ns: int) -> None:
        """Look at the clock until a datagram is due."""
        if now_ns < due_ns:
            since_ns = now_ns
            while now_ns < due_ns:
                now_ns = monotonic_ns()
            self._lead.looked(since_ns, now_ns)
        elif wake_ns == due_ns:
            self._lead.rests(now_ns)

    def _tell_origin(self, origin_ns: int | None) -> None:
        if origin_ns is not None:
            self._origin_known = True
            for lane in self._lanes:
                lane.origin_ns = origin_ns


LOOPBACK = "127.0.0.1"

_STOP_PERIOD = 0.1
"""How often `stop` is asked at least [s]."""


def bind_loopback(port: int = 0) -> socket.socket:
    """Open a UDP socket on 127.0.0.1; port 0 lets the kernel choose."""
    bound = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    bound.bind((LOOPBACK, port))
    return bound


class Relay:
    """Forwards datagrams between world and cloud through the two directions of a link."""

    def __init__(
        self,
        uplink: LinkDirection,
        downlink: LinkDirection,
        peek: Peek,
        *,
        world_side: socket.socket,
        cloud_side: socket.socket,
        world_peer: Address | None = None,
        cloud_peer: Address | None = None,
        in_flight_max: int = IN_FLIGHT_MAX,
    ) -> None:
        """Set up; the sockets stay the caller's to close.

        Args:
            uplink: World to cloud. Its time begins with 0 at the first datagram, as in virtual
                time, whatever the processes take to start: leave its origin at 0.
            downlink: Cloud to world, likewise.
            peek: Reads kind, epoch and counter of a datagram.
            world_side: Bound UDP socket that world sends to.
            cloud_side: Bound UDP socket that cloud sends to.
            world_peer: Where world listens; None takes the source of its first valid datagram.
            cloud_peer: Where cloud listens; None likewise.
            in_flight_max: Datagrams held at once in each direction; what comes on top is dropped
                and counted.
        """
        self._world = Side(world_side, world_peer)
        self._cloud = Side(cloud_side, cloud_peer)
        self._ways = {
            "uplink": Lane(self._world, self._cloud, uplink, peek, in_flight_max),
            "downlink": Lane(self._cloud, self._world, downlink, peek, in_flight_max),
        }
        self._lanes = Lanes(tuple(self._ways.values()), origin_ns=None)

    def run(self, stop: Callable[[], bool]) -> None:
        """Forward, once, until `stop` says True; it is asked at least every 0.1 s."""
        tighten_slack()
        try:
            while not stop():
                self._lanes.run(_STOP_PERIOD)
        finally:
            self._lanes.close()

    def take_in(self) -> None:
        """Put on the link whatever has come: to be called before a direction's profile changes."""
        self._lanes.take_in()

    def released(self, way: str) -> dict[str, int]:
        """Say how late datagrams of "uplink" or "downlink" left so far, as `Lane.released` does."""
        return self._ways[way].released()

    def outcomes(self) -> dict[str, int]:
        """Count datagrams by what became of them, both ways together, as `Lanes.outcomes` does."""
        return self._lanes.outcomes()

    def recent(self) -> dict[str, int]:
        """Say how late datagrams left of late, both ways together, as `Lanes.recent` does."""
        return self._lanes.recent()

    def counts(self) -> dict[str, float]:
        """Say what has happened so far, both ways together, as `Lanes.counts` does."""
        return self._lanes.counts()


class RelayShaper:
    """One direction of the link in userspace; a `Shaper`."""

    name = "relay"

    def __init__(self, listen: Address, direction: LinkDirection, peek: Peek) -> None:
        """Open the two sockets.

        Args:
            listen: Where this pod's tunnel end sends to; port 0 lets the kernel choose.
            direction: The link, its origin on the machine's monotonic clock.
            peek: Reads kind, epoch and counter of a datagram.

        Raises:
            OSError: If `listen` is taken.
        """
        self._inside = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._inside.bind(listen)
        except OSError:
            self._inside.close()
            raise
        # The kernel refuses to send from a socket bound to 127.0.0.1 to another machine.
        self._outside = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._lane = Lane(Side(self._inside), Side(self._outside), direction, peek)
        self._lanes = Lanes((self._lane,), origin_ns=0)
        tighten_slack()

    def follow_peer(self, peer: Address) -> Address:
        """Send to this peer from now on; what is in flight goes there, too."""
        self._lane.target.peer = peer
        host, port = self._inside.getsockname()
        return host, port

    def follow_profile(self, profile: DirectionProfile, *, restart: bool = False) -> None:
        """Shape by this profile from now on; what is in flight keeps the delay that it drew.

        Args:
            profile: Conditions.
            restart: Whether their time line counts from now; else from when the old one did.
        """
        self._lanes.take_in()  # what has come until now is of before
        self._lane.direction.replace_profile(profile, restart=restart)

    def step(self, timeout: float) -> None:
        """Forward for a moment, at most `timeout` [s]."""
        self._lanes.run(timeout)

    def counts(self) -> dict[str, int]:
        """Say how many datagrams met which outcome so far, and how late they left of late.

        As `Lanes.outcomes` and `Lanes.recent` do.
        """
        return self._lanes.outcomes() | self._lanes.recent()

    def released(self) -> dict[str, int]:
        """Say how late datagrams left since the beginning, as `Lane.released` does."""
        return self._lane.released()

    def close(self) -> None:
        """Close the sockets; what is in flight is lost."""
        self._lanes.close()
        self._inside.close()
        self._outside.close()
