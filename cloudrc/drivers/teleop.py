"""Run teleop in its own process and connect it with cloud over Unix datagram sockets.

    cloud process: CloudEndpoint - RemoteTeleop  <- two Unix sockets ->  serve_teleop - machine

No call blocks. A datagram is lost if the socket of the other process is full or missing. Either
process may restart: teleop repeats setpoint and requests, and keeps its events for a new cloud.
"""

from __future__ import annotations

import socket
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from cloudrc.errors import BadInputError
from cloudrc.messages import OperatorRequest, Request, Setpoint
from cloudrc.records import Fault, MissionEvent

DATAGRAM_MAX = 8_192
"""Size limit of a datagram [bytes]; all messages of teleop and cloud are smaller."""
DRAIN_MAX = 1024
"""Limit of the datagrams of one read; a socket queues fewer of them (513 under systemd)."""
PATH_MAX = 107
"""Longest path of a socket, without its final zero [bytes]. Source: unix(7), `sun_path`."""
PERIOD_NS = 20_000_000
"""Period of teleop's state machine [ns]."""
TELL_NS = PERIOD_NS - 5_000_000
"""Shortest time between two states for teleop [ns], so that it gets every second telemetry."""
ALIVE_NS = 200_000_000
"""Time between two empty datagrams [ns]; without telemetry they show teleop that cloud runs."""
STALL_NS = 100_000_000
"""Delay of the loop above which all datagrams in the socket count as old [ns], because the socket's
queue has been full since the delay began. Such a delay is a stall."""
BLIND_WAKES = 5
"""Number of loop periods that teleop waits for a new datagram after a stall, at most."""
SILENCE_NS = 1_000_000_000
"""Teleop, which sends at 10 Hz, counts as away after this time without a datagram [ns]."""
EVENTS_KEPT = 256
"""Limit of the events that wait while cloud is away."""
LAST_WORD_NS = 800_000_000
"""Time for which an ending cloud still forwards teleop's request to hold [ns]. Teleop repeats the
request for a shorter time, and a process has 1.5 s to end."""
Encode = Callable[[Any], bytes]
Decode = Callable[[bytes], Any]
"""Function that decodes a message; it raises a ValueError if the bytes are not a message."""
Calls = Callable[[], Iterable[Callable[[int], None]]]
"""Function that returns the calls that other threads have queued; each takes the time [ns]."""


class UnixPeer:
    """Exchange datagrams with another process over two Unix sockets."""

    def __init__(self, own: Path, other: Path) -> None:
        """Bind `own`, which may replace the socket of an earlier process; send to `other`.

        Raise a BadInputError if the path cannot be bound.
        """
        self._other = str(other)
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
        with suppress(BlockingIOError):
            while len(datagrams) < DRAIN_MAX:
                datagrams.append(self._socket.recv(DATAGRAM_MAX))
        return datagrams

    def send(self, data: bytes) -> bool:
        """Send a datagram; return whether the other socket has accepted it."""
        try:
            self._socket.sendto(data, self._other)
        except OSError:  # missing, restarting, or its queue is full
            return False
        return True

    def close(self) -> None:
        """Close the socket, but keep the socket file, which may already belong to a new process."""
        self._socket.close()


class RemoteTeleop:
    """Represent teleop in cloud's process: send telemetry to teleop, and receive its outputs.

    Attributes:
        outputs: Teleop's outputs since the last call of `take_outputs`.
    """

    outcome = None  # cloud does not end when a mission ends
    settled = True

    def __init__(self, peer: UnixPeer, encode: Encode, decode: Decode, start_ns: int) -> None:
        """Connect to teleop at `start_ns` [ns]."""
        self._peer, self._encode, self._decode = peer, encode, decode
        self._heard_ns: int | None = None  # or when teleop was told of the first telemetry
        self._silent = self._stalled = False
        self._tell_ns = self._looked_ns = self._alive_ns = start_ns
        self.outputs: list[Any] = []

    def see(self, seen: Any, now_ns: int) -> None:
        """Send the robot's state to teleop, at most every `TELL_NS`."""
        if now_ns >= self._tell_ns:
            self._tell_ns, self._alive_ns = now_ns + TELL_NS, now_ns + ALIVE_NS
            self._peer.send(self._encode(seen))
            if self._heard_ns is None:
                self._heard_ns = now_ns

    def handle_deadline(self, now_ns: int) -> None:
        """Receive teleop's outputs; report a fault if teleop has telemetry and is silent for 1 s.

        After a stall, drop starts and waypoints, because teleop may have withdrawn them in a
        datagram that the full socket lost. Teleop repeats the valid ones; the next call forwards
        them.
        """
        if now_ns >= self._alive_ns:
            self._alive_ns = now_ns + ALIVE_NS
            self._peer.send(b"")
        self._stalled = not self._stalled and now_ns - self._looked_ns > STALL_NS
        self._looked_ns = now_ns
        for data in self._peer.receive():
            with suppress(ValueError):
                output = self._decode(data)
                self._heard_ns, self._silent = now_ns, False
                if not (self._stalled and _moves_robot(output)):
                    self.outputs.append(output)
        heard_ns = now_ns if self._heard_ns is None else self._heard_ns
        if not self._silent and now_ns - heard_ns > SILENCE_NS:
            self._silent = True
            text = "no word from teleop for 1 s: the last setpoint is kept; see teleop's log"
            self.outputs.append(Fault(now_ns, "teleop_silent", text))

    def take_outputs(self) -> list[Any]:
        """Return teleop's outputs since the last call."""
        outputs, self.outputs = self.outputs, []
        return outputs


def _moves_robot(output: Any) -> bool:
    """Check whether an output starts a mission or leads to a waypoint."""
    if isinstance(output, OperatorRequest):
        return output.request is Request.START
    return isinstance(output, Setpoint) and output.waypoint >= 0


class LastWord:
    """Delay the end of cloud while the robot flies, to forward teleop's last request to hold."""

    def __init__(
        self,
        asked: Callable[[], bool],
        flies: Callable[[], bool],
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """Call `asked` (has cloud to end?), `flies` (does the robot fly?) and `clock` [ns]."""
        self._asked, self._flies, self._clock = asked, flies, clock
        self._until_ns: int | None = None

    def __call__(self) -> bool:
        """Return whether cloud may end now; cloud's loop calls this in every period."""
        if not self._asked():
            return False
        if self._until_ns is None:
            self._until_ns = self._clock() + LAST_WORD_NS
        return not self._flies() or self._clock() >= self._until_ns


def serve_teleop(
    machine: Any,
    peer: UnixPeer,
    encode: Encode,
    decode: Decode,
    *,
    calls: Calls,
    stops: Calls = list,
    tell: Callable[[list[MissionEvent | Fault]], None],
    stop: Callable[[], bool],
) -> None:
    """Run the loop of teleop's process at 50 Hz in real time until `stop()` returns true.

    `machine` is a `MissionService`, or has its methods hear, see, handle_deadline and take_outputs.
    `tell` receives the events and faults of each period, and must not block. For `calls` and
    `stops` see `turn`.
    """
    unsent: deque[bytes] = deque(maxlen=EVENTS_KEPT)
    deadline_ns, blind = time.monotonic_ns(), 0
    while not stop():
        # Do not wait for datagrams: telemetry is twice as frequent, and only the newest counts.
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
    machine: Any,
    peer: UnixPeer,
    decode: Decode,
    calls: Calls,
    *,
    stops: Calls = list,
    blind: int,
    late_ns: int,
    now_ns: int,
) -> int:
    """Run one period of teleop's loop: receive states, make the queued calls, send what is due.

    The period begins `late_ns` late, at `now_ns` [ns]. `calls` and `stops` return the queued calls
    and emergency stops. After a stall, teleop only receives datagrams until a new one arrives, for
    at most `BLIND_WAKES` periods. `blind` is the return value of the last period, at first 0: the
    number of periods that teleop still waits in this way.
    """
    arrived, was_blind = peer.receive(), blind
    states = [data for data in arrived if data]  # an empty datagram carries no state
    if blind:  # lateness does not count, so that a loop that is always late still continues
        blind = 0 if states else blind - 1
    elif late_ns > STALL_NS:
        blind = BLIND_WAKES
    if blind:
        return blind
    if arrived:
        machine.hear(now_ns)
    # Calls come before the state, which may already show the effect of a call or of its alarm.
    # After a stall, calls come after the state, because they may depend on the robot's position;
    # only stops do not.
    for stop in stops():
        stop(now_ns)
    seen = _newest(states, decode)
    if was_blind and seen is not None:
        machine.see(seen, now_ns)
    for call in calls():
        call(now_ns)
    if not was_blind and seen is not None:
        machine.see(seen, now_ns)
    machine.handle_deadline(now_ns)
    return 0


def send(
    outputs: Sequence[Any], unsent: deque[bytes], peer: UnixPeer, encode: Encode
) -> list[MissionEvent | Fault]:
    """Send outputs to cloud, after the events that wait in `unsent`; return events and faults."""
    while unsent and peer.send(unsent[0]):
        unsent.popleft()
    for output in outputs:
        if isinstance(output, MissionEvent):  # events keep their order
            data = encode(output)
            if unsent or not peer.send(data):
                unsent.append(data)
        elif not isinstance(output, Fault):  # teleop repeats all other outputs
            peer.send(encode(output))
    return [output for output in outputs if isinstance(output, MissionEvent | Fault)]


def _newest(arrived: list[bytes], decode: Decode) -> Any:
    """Decode the last datagram that is a valid message; None if there is none."""
    for data in reversed(arrived):
        with suppress(ValueError):
            return decode(data)
    return None
