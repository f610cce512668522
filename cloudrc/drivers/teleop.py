"""Teleop in a process of its own: its machine in real time, and what cloud has in its place.

    cloud process: CloudEndpoint - RemoteTeleop  <- two Unix sockets ->  serve_teleop - machine

Either process may restart: setpoint and requests are repeated, and what happened while cloud was
away is told to it when it is there again.

Unix datagram sockets: two processes of one machine, one message each way at a time.

Nothing here blocks and nothing is certain: what the other's full or missing socket refuses is
lost, as on a network. Paths are looked up with every datagram, so either process may restart.
"""

from __future__ import annotations

import socket
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol

from cloudrc.errors import BadInputError
from cloudrc.messages import OperatorRequest, Request, Setpoint
from cloudrc.records import Fault, MissionEvent

DATAGRAM_MAX = 8_192
"""Longer than any message of ours [bytes]."""
DRAIN_MAX = 1024
"""Datagrams taken per wake, so that a flood cannot keep a loop from its deadlines; more than wait
at once: systemd lets 513, so that nothing of a stall is left for the wake behind it."""
PATH_MAX = 107
"""Bytes of a socket's path, less its end. Source: unix(7), `sun_path`."""


class UnixPeer:
    """A Unix datagram socket of our own, and the path of the other's.

    Attributes:
        unsent: How many datagrams the other did not take.
    """

    def __init__(self, own: Path, other: Path) -> None:
        """Bind `own`, in the place of what an earlier process may have left there.

        Raises:
            BadInputError: If the path cannot be bound.
        """
        self._own, self._other = own, str(other)
        self.unsent = 0
        if len(bytes(own)) > PATH_MAX:
            raise BadInputError(f"--socket: {own} is longer than {PATH_MAX} bytes; choose another")
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            own.parent.mkdir(parents=True, exist_ok=True)
            own.unlink(missing_ok=True)
            self._socket.bind(str(own))
        except OSError as error:
            self._socket.close()
            raise BadInputError(f"--socket: cannot make {own}: {error.strerror}") from error

    def receive(self) -> list[bytes]:
        """Everything that waits in the socket."""
        datagrams: list[bytes] = []
        while len(datagrams) < DRAIN_MAX:
            try:
                datagrams.append(self._socket.recv(DATAGRAM_MAX))
            except BlockingIOError:
                break
        return datagrams

    def send(self, data: bytes) -> bool:
        """Send, if the other takes it now; say whether it did."""
        try:
            self._socket.sendto(data, self._other)
        except OSError:  # not there, not yet there again, or its queue is full
            self.unsent += 1
            return False
        return True

    def close(self) -> None:
        """Close; the path stays, since a successor may have bound it by now."""
        self._socket.close()


PERIOD_NS = 20_000_000
"""Between two deadlines of teleop's machine [ns]."""
TELL_NS = PERIOD_NS - 5_000_000
"""Teleop is told what is seen no more often than this [ns]: every second telemetry."""
ALIVE_NS = 200_000_000
"""Without telemetry teleop is told so often that cloud lives, by an empty datagram [ns]."""
STALL_NS = 100_000_000
"""After a wake this late what waits in the socket shows the past, for it has no room for more than
the beginning of a stall: the present comes with one of the next wakes [ns]."""
BLIND_WAKES = 5
"""So many of them may pass without it, and then what is asked is done all the same."""
SILENCE_NS = 1_000_000_000
"""Teleop speaks at 10 Hz; without a word for so long it is taken to be away [ns]."""
EVENTS_KEPT = 256
"""Events that wait for a cloud that is away."""
LAST_WORD_NS = 800_000_000
"""For teleop's last word to stop the robot, through a cloud that is to end as well [ns]: longer
than teleop repeats it, and short enough for a process that has 1.5 s to end."""

Encode = Callable[[Any], bytes]
Decode = Callable[[bytes], Any]
"""Raises ValueError for what is no message."""
Calls = Callable[[], Iterable[Callable[[int], None]]]
"""What other threads want to be done, here and now [ns]; must not block."""


class Machine(Protocol):
    """What teleop's process runs."""

    def hear(self, now_ns: int) -> None:
        """Take note that cloud lives."""

    def see(self, seen: Any, now_ns: int) -> None:
        """Take note of the newest telemetry."""

    def handle_deadline(self, now_ns: int) -> None:
        """Do what is due."""

    def take_outputs(self) -> Sequence[Any]:
        """Hand over what it has said since the last call."""


class RemoteTeleop:
    """Stands for teleop in cloud's process.

    Attributes:
        outcome: Always None: cloud does not end with a mission.
        settled: Always true.
        outputs: What teleop has said since the last call of `take_outputs`.
        malformed: How many datagrams were no messages.
    """

    outcome = None
    settled = True

    def __init__(self, peer: UnixPeer, encode: Encode, decode: Decode, start_ns: int) -> None:
        """Join the socket; teleop has a second from `start_ns` [ns] to speak."""
        self._peer, self._encode, self._decode = peer, encode, decode
        self._heard_ns, self._silent, self._stalled = start_ns, False, False
        self._tell_ns = self._looked_ns = self._alive_ns = start_ns
        self.outputs: list[Any] = []
        self.malformed = 0

    def see(self, seen: Any, now_ns: int) -> None:
        """Tell teleop what is seen, if it listens; as often as it looks."""
        if now_ns >= self._tell_ns:
            self._tell_ns, self._alive_ns = now_ns + TELL_NS, now_ns + ALIVE_NS
            self._peer.send(self._encode(seen))

    def handle_deadline(self, now_ns: int) -> None:
        """Take in what teleop has said; once it has been silent for a second, say so.

        Where there is no telemetry to tell, tell teleop that cloud lives.
        What led somewhere while cloud stood still may be taken back behind a full socket: teleop
        says it again if it is not. Not twice in a row: a cloud that is always late flies, too.
        """
        if now_ns >= self._alive_ns:
            self._alive_ns = now_ns + ALIVE_NS
            self._peer.send(b"")
        self._stalled = not self._stalled and now_ns - self._looked_ns > STALL_NS
        self._looked_ns = now_ns
        for data in self._peer.receive():
            try:
                said = self._decode(data)
            except ValueError:
                self.malformed += 1
                continue
            self._heard_ns, self._silent = now_ns, False
            if not (self._stalled and _leads(said)):
                self.outputs.append(said)
        if not self._silent and now_ns - self._heard_ns > SILENCE_NS:
            self._silent = True
            text = "teleop has been silent for 1 s: the last setpoint is kept; see teleop's log"
            self.outputs.append(Fault(now_ns, "teleop_silent", text))

    def take_outputs(self) -> list[Any]:
        """Hand over what teleop has said since the last call."""
        outputs, self.outputs = self.outputs, []
        return outputs


class LastWord:
    """Lets cloud end: a moment later if the robot flies, for that is for teleop to hold.

    A pod asks all its containers to end at once; what teleop then says has no way but cloud's.
    """

    def __init__(
        self,
        asked: Callable[[], bool],
        flies: Callable[[], bool],
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """Wait for nothing yet.

        Args:
            asked: Whether cloud is to end.
            flies: Whether the robot is seen to follow commands.
            clock: Own clock [ns].
        """
        self._asked, self._flies, self._clock = asked, flies, clock
        self._until_ns: int | None = None

    def __call__(self) -> bool:
        """Whether cloud may end now; asked at every wake."""
        if not self._asked():
            return False
        if self._until_ns is None:
            self._until_ns = self._clock() + LAST_WORD_NS
        return not self._flies() or self._clock() >= self._until_ns


def serve_teleop(
    machine: Machine,
    peer: UnixPeer,
    encode: Encode,
    decode: Decode,
    *,
    calls: Calls,
    stops: Calls = list,
    tell: Callable[[list[MissionEvent | Fault]], None],
    stop: Callable[[], bool],
) -> None:
    """Run teleop's machine in real time until `stop()` is true.

    Args:
        machine: Gets 50 deadlines a second, before each the newest of what is seen.
        peer: The socket to cloud.
        encode: Writes a message for cloud.
        decode: Reads one from cloud.
        calls: See `turn`.
        stops: See `turn`.
        tell: Gets events and faults, at every wake that has some; must not block.
        stop: Asked at every wake.
    """
    unsent: deque[bytes] = deque(maxlen=EVENTS_KEPT)
    deadline_ns, blind = time.monotonic_ns(), 0
    while not stop():
        # Not woken by what comes: telemetry is twice as frequent, and of several the newest counts.
        time.sleep(max(0, deadline_ns - time.monotonic_ns()) * 1e-9)
        now_ns = time.monotonic_ns()
        late_ns = now_ns - deadline_ns
        deadline_ns += (late_ns // PERIOD_NS + 1) * PERIOD_NS
        blind = turn(
            machine, peer, decode, calls, stops=stops, blind=blind, late_ns=late_ns, now_ns=now_ns
        )
        if not blind and (told := send(machine.take_outputs(), unsent, peer, encode)):
            tell(told)


def turn(
    machine: Machine,
    peer: UnixPeer,
    decode: Decode,
    calls: Calls,
    *,
    stops: Calls = list,
    blind: int,
    late_ns: int,
    now_ns: int,
) -> int:
    """Do what is due at one wake of teleop.

    Args:
        machine: Sees, is asked, and gets its deadline.
        peer: The socket to cloud.
        decode: Reads a message from cloud.
        calls: What is wanted.
        stops: Of these the emergency stops, which are made first.
        blind: What was returned at the wake before; 0 at first.
        late_ns: By how much this wake is late [ns].
        now_ns: Now [ns].

    Returns:
        For how many wakes more teleop does not look; as long as there are any, nothing is done.
    """
    arrived, was_blind = peer.receive(), blind
    told = [data for data in arrived if data]  # what is empty shows nothing, past or present
    blind = blind_for(was_blind, late_ns, bool(told))
    if blind:
        return blind
    if arrived:
        machine.hear(now_ns)
    for stop in stops():  # first: what has arrived may already show what their alarm has done
        stop(now_ns)
    seen = _newest(told, decode)
    if was_blind and seen is not None:  # first: a call may be about where the robot is
        machine.see(seen, now_ns)
    for call in calls():  # first: what has arrived may already show what a call asked for
        call(now_ns)
    if not was_blind and seen is not None:
        machine.see(seen, now_ns)
    machine.handle_deadline(now_ns)
    return 0


def blind_for(before: int, late_ns: int, arrived: bool) -> int:
    """Say for how many wakes more teleop does not look; a loop that is always late looks in turns.

    Args:
        before: What was said at the wake before.
        late_ns: By how much this one is late [ns].
        arrived: Whether something waits in the socket.
    """
    if before:
        return 0 if arrived else before - 1
    return BLIND_WAKES if late_ns > STALL_NS else 0


def send(
    outputs: Sequence[Any], unsent: deque[bytes], peer: UnixPeer, encode: Encode
) -> list[MissionEvent | Fault]:
    """Send what is for cloud, first the events that still wait for it in `unsent`.

    Returns:
        What is to be told elsewhere, too.
    """
    told: list[MissionEvent | Fault] = []
    while unsent and peer.send(unsent[0]):
        unsent.popleft()
    for output in outputs:
        if isinstance(output, MissionEvent | Fault):
            told.append(output)
        if isinstance(output, Fault):
            continue
        data = encode(output)
        once = isinstance(output, MissionEvent)
        # Events keep their order; everything else is repeated anyway.
        if (once and unsent) or not peer.send(data):
            if once:
                unsent.append(data)
    return told


def _leads(said: Any) -> bool:
    """Whether it is to start, or to fly to a waypoint; an end, a stop and a hold are neither."""
    if isinstance(said, OperatorRequest):
        return said.request is Request.START
    return isinstance(said, Setpoint) and said.waypoint >= 0


def _newest(arrived: list[bytes], decode: Decode) -> Any:
    """Decode the last datagram that is a message; None if none is."""
    for data in reversed(arrived):
        with suppress(ValueError):
            return decode(data)
    return None
