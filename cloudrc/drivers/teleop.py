"""Run teleop in its own process and connect it with cloud over Unix datagram sockets.

    cloud process: CloudEndpoint - RemoteTeleop  <- two Unix sockets ->  serve_teleop - machine

No call blocks. A datagram is lost, as on a network, if the socket of the other process is full or
missing. Either process may restart: the socket's path is looked up for each datagram, setpoint and
requests are repeated, and events wait until cloud is back.
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
"""Size limit of a datagram [bytes]; all our messages are smaller."""
DRAIN_MAX = 1024
"""Largest number of datagrams per wake; with this limit, a flood cannot delay a loop's deadlines.
The limit is above the socket's queue (513 under systemd), so that one wake after a stall takes all
waiting datagrams."""
PATH_MAX = 107
"""Longest path of a socket, without its final zero [bytes]. Source: unix(7), `sun_path`."""


class UnixPeer:
    """Our Unix datagram socket and the path of the other process's socket.

    Attributes:
        unsent: Number of datagrams that the other socket refused.
    """

    def __init__(self, own: Path, other: Path) -> None:
        """Bind `own` and replace a socket that an earlier process left there.

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
        """Return the datagrams that wait in the socket."""
        datagrams: list[bytes] = []
        while len(datagrams) < DRAIN_MAX:
            try:
                datagrams.append(self._socket.recv(DATAGRAM_MAX))
            except BlockingIOError:
                break
        return datagrams

    def send(self, data: bytes) -> bool:
        """Send a datagram; return whether the other socket has accepted it."""
        try:
            self._socket.sendto(data, self._other)
        except OSError:  # missing, restarting, or its queue is full
            self.unsent += 1
            return False
        return True

    def close(self) -> None:
        """Close the socket; its path stays, since a successor may already have bound it."""
        self._socket.close()


PERIOD_NS = 20_000_000
"""Period of teleop's state machine [ns]."""
TELL_NS = PERIOD_NS - 5_000_000
"""Shortest time between two robot states sent to teleop [ns]. With this value teleop gets every
second telemetry message."""
ALIVE_NS = 200_000_000
"""Time between two empty datagrams to teleop while there is no telemetry [ns]. Empty datagrams tell
teleop that cloud runs."""
STALL_NS = 100_000_000
"""If a wake is later than this, the socket holds only old datagrams [ns]: the queue has been full
since the start of the stall. New datagrams arrive within the next wakes."""
BLIND_WAKES = 5
"""Largest number of wakes that wait for a new datagram after a stall [1]. Then teleop continues
without a new datagram."""
SILENCE_NS = 1_000_000_000
"""Time without a datagram from teleop after which teleop counts as away [ns]; teleop sends at 10
Hz."""
EVENTS_KEPT = 256
"""Largest number of events that wait while cloud is away [1]."""
LAST_WORD_NS = 800_000_000
"""How long cloud, while it ends, still forwards teleop's last hold request [ns]. This is longer
than teleop repeats the request, and shorter than the 1.5 s that a process has to end."""

Encode = Callable[[Any], bytes]
Decode = Callable[[bytes], Any]
"""Function that decodes a message; it raises a ValueError if the bytes are not a message."""
Calls = Callable[[], Iterable[Callable[[int], None]]]
"""Function that returns the calls that other threads have queued. Each call takes the current time
[ns] and must not block."""


class Machine(Protocol):
    """The state machine that teleop's process runs."""

    def hear(self, now_ns: int) -> None:
        """Note that cloud runs."""

    def see(self, seen: Any, now_ns: int) -> None:
        """Note the newest robot state."""

    def handle_deadline(self, now_ns: int) -> None:
        """Do what is due at `now_ns` [ns]."""

    def take_outputs(self) -> Sequence[Any]:
        """Return the machine's outputs since the last call."""


class RemoteTeleop:
    """Represents teleop in cloud's process.

    Attributes:
        outcome: Always None, because cloud does not end when a mission ends.
        settled: Always True.
        outputs: Teleop's outputs since the last call of `take_outputs`.
        malformed: Number of datagrams that were no messages.
    """

    outcome = None
    settled = True

    def __init__(self, peer: UnixPeer, encode: Encode, decode: Decode, start_ns: int) -> None:
        """Connect to teleop at `start_ns` [ns].

        From then on teleop has one second to send its first datagram.
        """
        self._peer, self._encode, self._decode = peer, encode, decode
        self._heard_ns, self._silent, self._stalled = start_ns, False, False
        self._tell_ns = self._looked_ns = self._alive_ns = start_ns
        self.outputs: list[Any] = []
        self.malformed = 0

    def see(self, seen: Any, now_ns: int) -> None:
        """Send the robot's state to teleop, at most every `TELL_NS`."""
        if now_ns >= self._tell_ns:
            self._tell_ns, self._alive_ns = now_ns + TELL_NS, now_ns + ALIVE_NS
            self._peer.send(self._encode(seen))

    def handle_deadline(self, now_ns: int) -> None:
        """Receive teleop's outputs; report a fault once teleop is silent for a second.

        Without telemetry an empty datagram tells teleop that cloud runs.

        After a stall, starts and waypoints are dropped: teleop may have withdrawn them in a
        datagram that was lost because the socket was full. Teleop repeats the outputs that are
        still valid. Outputs are not dropped twice in a row, so that a cloud that is always late can
        fly.
        """
        if now_ns >= self._alive_ns:
            self._alive_ns = now_ns + ALIVE_NS
            self._peer.send(b"")
        self._stalled = not self._stalled and now_ns - self._looked_ns > STALL_NS
        self._looked_ns = now_ns
        for data in self._peer.receive():
            try:
                output = self._decode(data)
            except ValueError:
                self.malformed += 1
                continue
            self._heard_ns, self._silent = now_ns, False
            if not (self._stalled and _moves_robot(output)):
                self.outputs.append(output)
        if not self._silent and now_ns - self._heard_ns > SILENCE_NS:
            self._silent = True
            text = "no word from teleop for 1 s: the last setpoint is kept; see teleop's log"
            self.outputs.append(Fault(now_ns, "teleop_silent", text))

    def take_outputs(self) -> list[Any]:
        """Return teleop's outputs since the last call."""
        outputs, self.outputs = self.outputs, []
        return outputs


class LastWord:
    """Delays the end of cloud's process while the robot flies, so that teleop can request a hold.

    A pod ends all its containers at once, and teleop's requests pass through cloud.
    """

    def __init__(
        self,
        asked: Callable[[], bool],
        flies: Callable[[], bool],
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """Set the functions; nobody has asked cloud to end yet.

        Args:
            asked: Whether somebody has asked cloud to end.
            flies: Whether telemetry shows that the robot follows commands.
            clock: Own clock [ns].
        """
        self._asked, self._flies, self._clock = asked, flies, clock
        self._until_ns: int | None = None

    def __call__(self) -> bool:
        """Return whether cloud may end now; called at every wake."""
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
        machine: Gets 50 deadlines a second, and before each deadline the newest robot state.
        peer: The socket to cloud.
        encode: Encodes a message for cloud.
        decode: Decodes a message from cloud.
        calls: Returns the queued calls.
        stops: Returns the queued emergency stops, which are made first.
        tell: Gets the events and faults of each wake; must not block.
        stop: Called at every wake.
    """
    unsent: deque[bytes] = deque(maxlen=EVENTS_KEPT)
    deadline_ns, blind = time.monotonic_ns(), 0
    while not stop():
        # Datagrams do not wake it: telemetry is twice as frequent, and only the newest counts.
        time.sleep(max(0, deadline_ns - time.monotonic_ns()) * 1e-9)
        now_ns = time.monotonic_ns()
        late_ns = now_ns - deadline_ns
        deadline_ns += (late_ns // PERIOD_NS + 1) * PERIOD_NS
        blind = turn(
            machine, peer, decode, calls, stops=stops, blind=blind, late_ns=late_ns, now_ns=now_ns
        )
        if not blind and (reports := send(machine.take_outputs(), unsent, peer, encode)):
            tell(reports)


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
    """Run one wake of teleop: receive states, make the queued calls, handle the deadline.

    Args:
        machine: Gets states, calls and its deadline.
        peer: The socket to cloud.
        decode: Decodes a message from cloud.
        calls: Returns the queued calls.
        stops: Returns the queued emergency stops, which are made first.
        blind: Return value of the last wake; 0 at first.
        late_ns: Lateness of this wake [ns].
        now_ns: Now [ns].

    Returns:
        Number of further wakes that wait for a new datagram. If the number is above 0, this wake
        has only received datagrams.
    """
    arrived, was_blind = peer.receive(), blind
    states = [data for data in arrived if data]  # an empty datagram carries no state
    blind = blind_for(was_blind, late_ns, bool(states))
    if blind:
        return blind
    if arrived:
        machine.hear(now_ns)
    for stop in stops():  # before the state, which may already show the effect of their alarm
        stop(now_ns)
    seen = _newest(states, decode)
    if was_blind and seen is not None:  # before the calls, which may depend on the robot's place
        machine.see(seen, now_ns)
    for call in calls():  # before the state, which may already show the effect of a call
        call(now_ns)
    if not was_blind and seen is not None:
        machine.see(seen, now_ns)
    machine.handle_deadline(now_ns)
    return 0


def blind_for(before: int, late_ns: int, arrived: bool) -> int:
    """Return how many further wakes wait for a new datagram after a stall.

    Lateness does not count during the wait, so that a loop that is always late still continues.

    Args:
        before: Return value of the last wake.
        late_ns: Lateness of this wake [ns].
        arrived: Whether a datagram with a state has arrived.
    """
    if before:
        return 0 if arrived else before - 1
    return BLIND_WAKES if late_ns > STALL_NS else 0


def send(
    outputs: Sequence[Any], unsent: deque[bytes], peer: UnixPeer, encode: Encode
) -> list[MissionEvent | Fault]:
    """Send outputs to cloud; the events that wait in `unsent` are sent first.

    Returns:
        The events and faults among the outputs.
    """
    reports: list[MissionEvent | Fault] = []
    while unsent and peer.send(unsent[0]):
        unsent.popleft()
    for output in outputs:
        if isinstance(output, MissionEvent | Fault):
            reports.append(output)
        if isinstance(output, Fault):
            continue
        data = encode(output)
        is_event = isinstance(output, MissionEvent)
        # Events keep their order; everything else is repeated anyway.
        if (is_event and unsent) or not peer.send(data):
            if is_event:
                unsent.append(data)
    return reports


def _moves_robot(output: Any) -> bool:
    """Check whether an output starts a mission or leads to a waypoint."""
    if isinstance(output, OperatorRequest):
        return output.request is Request.START
    return isinstance(output, Setpoint) and output.waypoint >= 0


def _newest(arrived: list[bytes], decode: Decode) -> Any:
    """Decode the last datagram that is a valid message; None if there is none."""
    for data in reversed(arrived):
        with suppress(ValueError):
            return decode(data)
    return None
