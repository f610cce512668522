# SPDX-License-Identifier: Apache-2.0

"""Run teleop in its own process, and connect the processes of teleop and cloud by Unix sockets.

No call blocks. A datagram is lost if the socket of the receiver is full or missing. Each process
may restart while the other runs: teleop repeats its setpoint and requests, and stores mission
events until cloud accepts them.
"""

from __future__ import annotations

import socket
import time
from collections import deque
from collections.abc import Callable, Sequence
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

from cloudrc.base.files import at_place
from cloudrc.link.carry.datagrams import receive_all
from cloudrc.teleop.wire import Message, Output, RobotStatus, decode, encode
from cloudrc.wire.messages import OperatorRequest, Request, Setpoint
from cloudrc.wire.records import Fault, MissionEvent

if TYPE_CHECKING:
    from cloudrc.teleop.service import MissionService

DATAGRAM_MAX = 8_192
"""Size limit of a datagram between teleop and cloud [bytes]; all messages are smaller."""
DRAIN_MAX = 1024
"""Largest number of messages that `receive` returns at once: more than a socket can queue."""
PERIOD_NS = 20_000_000
"""Period of the loop of teleop's process [ns]."""
TELL_NS = PERIOD_NS - 5_000_000
"""Shortest time between two telemetry messages that cloud forwards to teleop [ns]."""
ALIVE_NS = 200_000_000
"""Period of empty datagrams [ns]. Without telemetry, cloud sends them to show that it runs."""
STALL_NS = 100_000_000
"""Lateness above which a loop was stalled [ns]: its socket may be full of old datagrams."""
BLIND_WAKES = 5
"""Largest number of periods after a stall for which teleop waits for a new state of the robot."""
SILENCE_NS = 1_000_000_000
"""Time without a datagram from teleop after which cloud reports a fault [ns]."""
EVENTS_KEPT = 256
"""Largest number of mission events that teleop stores while cloud does not accept them."""
Make = Callable[[int], None]
"""Function that makes the calls that other threads have queued, at a time [ns], monotonic clock."""


def bind_datagrams(path: Path) -> socket.socket:
    """Open a socket for datagrams at `path`, in place of that of an earlier process."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    datagrams = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    datagrams.setblocking(False)
    with at_place(path):
        datagrams.bind(str(path))
    return datagrams


class UnixDatagrams:
    """Exchanges datagrams with another process over two Unix sockets."""

    def __init__(self, own: Path, other: Path, size_max: int = DATAGRAM_MAX) -> None:
        """Bind the path `own`, in place of an earlier process's socket; send to the path `other`.

        `size_max` is the size limit of a datagram [bytes].
        """
        self._other, self._size_max = str(other), size_max
        self._socket = bind_datagrams(own)

    def fileno(self) -> int:
        """Return the descriptor of the socket, to wait for datagrams."""
        return self._socket.fileno()

    def receive_data(self) -> list[bytes]:
        """Return the datagrams that have arrived."""
        return list(islice(receive_all(self._socket, self._size_max), DRAIN_MAX))

    def send_data(self, data: bytes) -> bool:
        """Send a datagram; return whether it was accepted.

        False means that the other process does not run, or that the queue of its socket is full.
        """
        try:
            self._socket.sendto(data, self._other)
        except OSError:  # the other process does not run, or its queue is full
            return False
        return True

    def close(self) -> None:
        """Close the socket, but keep the socket file, which may already belong to a new process."""
        self._socket.close()


class UnixPeer(UnixDatagrams):
    """Exchanges the messages of teleop and cloud with the other process."""

    def receive(self) -> list[Message | None]:
        """Return the messages that have arrived.

        None in the list stands for an empty datagram, a sign of life of the other process.
        """
        return [decode(data) if data else None for data in self.receive_data()]

    def send(self, message: Message | None) -> bool:
        """Send a message (None: an empty datagram, a sign of life); return whether it was accepted.

        False means that the other process does not run, or that the queue of its socket is full.
        """
        return self.send_data(b"" if message is None else encode(message))


class RemoteTeleop:
    """Represents teleop in cloud's process: sends telemetry to teleop and receives its outputs.

    Attributes:
        outputs: Requests, setpoints and events from teleop since the last call of `take_outputs`.
    """

    def __init__(self, peer: UnixPeer, start_ns: int) -> None:
        self._peer = peer
        # Time of teleop's last datagram; before one, time of the first telemetry sent to teleop.
        self._heard_ns: int | None = None
        self._silent = self._stalled = False
        self._tell_ns = self._looked_ns = self._alive_ns = start_ns
        self.outputs: list[Output | Fault] = []

    def see(self, seen: RobotStatus, now_ns: int) -> None:
        """Send `seen`, the status of the robot, to teleop; at most once per `TELL_NS`."""
        if now_ns >= self._tell_ns:
            self._tell_ns, self._alive_ns = now_ns + TELL_NS, now_ns + ALIVE_NS
            self._peer.send(seen)
            if self._heard_ns is None:
                self._heard_ns = now_ns

    def handle_deadline(self, now_ns: int) -> None:
        """Receive teleop's outputs; report a fault if teleop does not answer telemetry for 1 s.

        If cloud has stalled, ignore outputs that start a mission or lead to a waypoint. They may be
        old: teleop may have cancelled them since. Teleop repeats outputs that are still valid.
        """
        if now_ns >= self._alive_ns:
            self._alive_ns = now_ns + ALIVE_NS
            self._peer.send(None)
        self._stalled = not self._stalled and now_ns - self._looked_ns > STALL_NS
        self._looked_ns = now_ns
        for output in self._peer.receive():
            if output is None or isinstance(output, RobotStatus):
                continue
            self._heard_ns, self._silent = now_ns, False
            if not (self._stalled and _moves_robot(output)):
                self.outputs.append(output)
        heard_ns = now_ns if self._heard_ns is None else self._heard_ns
        if not self._silent and now_ns - heard_ns > SILENCE_NS:
            self._silent = True
            text = "no message from teleop for 1 s: the last setpoint is kept; see teleop's log"
            self.outputs.append(Fault(now_ns, "teleop_silent", text))

    def take_outputs(self) -> list[Output | Fault]:
        """Return and remove the outputs that have arrived since the last call."""
        outputs, self.outputs = self.outputs, []
        return outputs


def _moves_robot(output: Output) -> bool:
    if isinstance(output, OperatorRequest):
        return output.request is Request.START
    return isinstance(output, Setpoint) and output.waypoint >= 0


class TeleopLoop:
    """Loop of teleop's process: receives the robot's state, executes API calls, sends outputs."""

    def __init__(
        self,
        machine: MissionService,
        peer: UnixPeer,
        tell: Callable[[list[MissionEvent | Fault]], None],
        *,
        calls: Make = lambda now_ns: None,
        stops: Make = lambda now_ns: None,
    ) -> None:
        """Connect `machine` to `peer`.

        `tell` is called with the events and faults of each period, and must not block. `stops`
        executes the queued API calls for an emergency stop or a hold, `calls` all others.
        """
        self._machine, self._peer, self._tell = machine, peer, tell
        self._calls, self._stops = calls, stops
        self._unsent: deque[MissionEvent] = deque(maxlen=EVENTS_KEPT)
        self._blind = 0  # number of periods for which teleop still waits for a new state

    def run(self, stop: Callable[[], bool]) -> None:
        """Run at 50 Hz in real time until `stop()` returns true."""
        deadline_ns = time.monotonic_ns()
        while not stop():
            # Do not wake for each message: only the newest state is needed per period.
            time.sleep(max(0, deadline_ns - time.monotonic_ns()) * 1e-9)
            now_ns = time.monotonic_ns()
            late_ns = now_ns - deadline_ns
            deadline_ns += (late_ns // PERIOD_NS + 1) * PERIOD_NS
            self.wake(now_ns, late_ns)

    def wake(self, now_ns: int, late_ns: int) -> None:
        """Run one period at `now_ns` [ns]; `late_ns` is its delay after the planned time [ns].

        After a long delay, the socket contains old states of the robot, but API calls may depend on
        the present position. Therefore teleop discards the old states, and does nothing until a new
        state arrives, for at most `BLIND_WAKES` periods.
        """
        machine, arrived = self._machine, self._peer.receive()
        states = [state for state in arrived if isinstance(state, RobotStatus)]
        if self._blind:  # ignore `late_ns`: otherwise a loop that is always late would wait forever
            self._blind = 0 if states else self._blind - 1
        elif late_ns > STALL_NS:
            self._blind = BLIND_WAKES
        if self._blind:
            return
        if arrived:
            machine.hear(now_ns)
        # A stop or a hold is queued before a state can show its effect, so these come first.
        self._stops(now_ns)
        if states:
            machine.see(states[-1], now_ns)
        self._calls(now_ns)
        machine.handle_deadline(now_ns)
        self._send(machine.take_outputs())

    def _send(self, outputs: Sequence[Output | Fault]) -> None:
        """Send unsent events, then `outputs`, to cloud; pass new events and faults to `tell`."""
        unsent, peer = self._unsent, self._peer
        while unsent and peer.send(unsent[0]):
            unsent.popleft()
        for output in outputs:
            if isinstance(output, MissionEvent):  # queue an event behind unsent ones
                if unsent or not peer.send(output):
                    unsent.append(output)
            elif not isinstance(output, Fault):  # may be lost: teleop repeats these outputs
                peer.send(output)
        if news := [output for output in outputs if isinstance(output, MissionEvent | Fault)]:
            self._tell(news)
