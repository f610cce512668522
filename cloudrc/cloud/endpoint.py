# SPDX-License-Identifier: Apache-2.0

"""Cloud's end of the tunnel: receive telemetry and send a command in every period.

Cloud asks for a session with HELLO datagrams, and uses the epoch (session number) that world
assigns. While there is no command, cloud sends ALIVE datagrams, so that world does not give the
session to another cloud.

Cloud and teleop exchange messages only. Teleop gets the robot's status, and returns setpoints and
the operator's requests.
"""

from __future__ import annotations

from collections.abc import Callable
from math import nan
from typing import Any

from cloudrc.base.errors import ControllerLostError
from cloudrc.cloud.compute_time import ComputeTime
from cloudrc.cloud.frame_receiver import FrameReceiver
from cloudrc.cloud.loop import ControlLoop
from cloudrc.cloud.operator import (
    EmergencyStopRepeater,
    Operator,
    is_for_session,
    make_robot_status,
)
from cloudrc.cloud.perceiving import Perceiver
from cloudrc.cloud.sensor_receiver import KINDS, SensorReceiver
from cloudrc.wire.messages import (
    NEVER_NS,
    Datagram,
    GuardState,
    OperatorRequest,
    Request,
    Setpoint,
    Telemetry,
)
from cloudrc.wire.records import (
    UNDER_WAY,
    Arrival,
    Control,
    Counted,
    Left,
    MissionEvent,
    SessionOpened,
)
from cloudrc.wire.tunnel import codec
from cloudrc.wire.tunnel.codec import Accept, DecodeError, Direction, Kind
from cloudrc.wire.tunnel.end import Identity, TunnelEnd
from cloudrc.wire.tunnel.handshake import BUSY_TEXT, SILENCE_TEXT, ClientHandshake
from cloudrc.wire.tunnel.session import NO_EPOCH
from cloudrc.wire.tunnel.window import LATE, REPEATED, USED

LATE_NS, LATE_WINDOW_NS = 500_000_000, 10_000_000_000
"""Cloud reports a fault, once per session, if the periods that it misses within LATE_WINDOW_NS add
up to more than LATE_NS, 5 % [ns]."""
LATE_TEXT = (
    "cloud misses more than 5 % of its periods: a plug-in is slow, cloud.compute_ms is long, "
    "or the machine is busy"
)
HELLO_PERIOD_NS = 100_000_000
"""Shortest time between two periodic hellos [ns]."""
KEY_PERIOD_NS = 5_000_000_000
"""Time between two hellos with a new pre-shared key while the session uses the old key [ns]. Until
world has the new key, world counts the hellos as forged; 12 hellos a minute raise no alert."""
SILENCE_NS = 500_000_000
"""Time without telemetry after which cloud asks for a session again [ns]."""
ALIVE_PERIOD_NS = 100_000_000
"""Time between two ALIVE datagrams while there is no command [ns]."""
PATIENCE_NS = 5_000_000_000
"""Time without a session after which cloud reports a fault [ns]."""
COUNT_PERIOD_NS = 1_000_000_000
"""Time between two records of the counters [ns]."""
SILENT_PERIODS = 3
"""With answers on arrival, cloud sends a command after so many half periods without newer
telemetry: the guard needs 10 in 500 ms to leave HOLD."""
COMMAND, TELEMETRY = int(Kind.COMMAND), int(Kind.TELEMETRY)  # often used
_new = tuple.__new__  # makes a named tuple twice as fast as its class does


class CloudEndpoint(TunnelEnd):
    """The remote controller's end of the tunnel: an `Endpoint` that commands the robot.

    Attributes:
        teleop: Source of setpoints and operator requests.
        telemetry: The newest telemetry; None before the first.
        watch: Is called with epoch, counter and content of each telemetry that cloud uses.
        sensors: Receives what the robot sees.
    """

    telemetry: Telemetry | None = None

    def __init__(
        self,
        loop: ControlLoop,
        teleop: Operator,
        identity: Identity,
        *,
        newest_wins: bool,
        compute: ComputeTime | None = None,
        perceiver: Perceiver | None = None,
        frames: FrameReceiver | None = None,
        start_ns: int = 0,
        on_arrival: bool = False,
    ) -> None:
        """Connect the parts; there is no session yet.

        Args:
            loop: Estimator, predictor and controller.
            teleop: Source of setpoints and operator requests.
            identity: Identity and keys of this end.
            newest_wins: Whether to drop telemetry that arrives after newer telemetry.
            compute: The simulated time between computation and departure of a command; None: 0.
            perceiver: As `SensorReceiver` takes it.
            frames: As `SensorReceiver` takes it.
            start_ns: The present time on cloud's monotonic clock [ns].
            on_arrival: Whether newer telemetry, and not a period, makes a command due.
        """
        super().__init__(identity, Direction.DOWNLINK, loop.counts, newest_wins=newest_wins)
        self._loop, self.teleop = loop, teleop
        self._handshake = ClientHandshake(identity.nonce, identity.clock_id)
        self._hellos = 0
        self._setpoint: Setpoint | None = None
        self._perceiver, self.sensors = perceiver, SensorReceiver(perceiver, frames, loop.counts)
        self._world = ""  # identifies the world process of the session
        self.watch: Callable[[int, int, Telemetry], None] | None = None
        self._control: Control | None = None  # record of the session's last command
        self._uplink_delay = nan  # of the newest telemetry [s]
        self._alarm = EmergencyStopRepeater()
        self._period_ns = loop.period_ns
        self._compute = compute
        self._unsent: tuple[int, Datagram | None] | None = None  # departure [ns] and command
        self._asked = 0  # highest number of an operator request in this session
        self._start: tuple[int, int] | None = None  # number and time [ns] of the newest START
        self._on_arrival, self._due_ns = on_arrival, start_ns  # when a command is due, if so [ns]
        self._tick_ns = self._heard_ns = start_ns
        self._hello_ns = start_ns - KEY_PERIOD_NS  # time of the last periodic hello
        # Time of the next ALIVE while there are no commands, and while they are withheld.
        self._alive_ns = self._quiet_ns = start_ns
        self._commanded_ns = NEVER_NS
        self._count_ns = start_ns + COUNT_PERIOD_NS
        self._late_ns, self._late_window_ns = 0, start_ns  # missed time, begin of its window [ns]

    @property
    def lost(self) -> ControllerLostError | None:
        """Why the flight has to end, if a controller outside is lost; else None."""
        return self._loop.lost

    @property
    def guard(self) -> GuardState:
        """State of the guard in the newest telemetry."""
        return GuardState.GROUND if self.telemetry is None else self.telemetry.guard

    def next_deadline_ns(self) -> int:
        """Return when cloud has to send a computed command or to compute the next command [ns]."""
        if self._unsent is not None:
            return self._unsent[0]
        if self._on_arrival and self._can_answer:
            return min(self._tick_ns, self._due_ns)
        return self._tick_ns

    @property
    def _can_answer(self) -> bool:
        """Whether cloud has what it needs for a command."""
        has_session = self._session.epoch != NO_EPOCH
        return self._loop.ready and self._setpoint is not None and has_session

    def finish(self, now_ns: int) -> None:
        """Let the computation of the present command end at `now_ns` [ns]."""
        if self._unsent is not None:
            self._unsent = now_ns, self._unsent[1]

    def handle_deadline(self, now_ns: int) -> None:
        """Send the datagrams that are due at `now_ns` [ns]; skip missed periods."""
        if self._unsent is not None or now_ns < self._tick_ns:
            if now_ns < self.next_deadline_ns():
                return
            if self._unsent is not None:
                self._send_computed(self._unsent[1], now_ns)
            if now_ns < self._tick_ns:
                self._answer_if_due(now_ns)
                return
        missed = (now_ns - self._tick_ns) // self._period_ns
        if missed:
            self._note_missed(missed, now_ns)
        self._tick_ns += (missed + 1) * self._period_ns
        self._session.follow_keys()
        session = self._session
        lacks = session.epoch == NO_EPOCH or now_ns - self._heard_ns > SILENCE_NS
        if lacks or session.is_outdated:
            self._ask_for_session_if_due(now_ns, lacks=lacks)
        self._act(now_ns)
        if self._perceiver is not None:
            self._records += self._perceiver.take_records()
        if now_ns >= self._count_ns:
            self._count_ns = max(self._count_ns, now_ns - COUNT_PERIOD_NS) + COUNT_PERIOD_NS
            self._record_counts(now_ns)
        if self._loop.faults:
            self._records += self._loop.take_faults()

    def _send_computed(self, datagram: Datagram | None, now_ns: int) -> None:
        """Send the command whose computation is over, if there is one."""
        self._unsent = None
        if datagram is not None:
            self._queue(datagram)
            if (made := self._control) is not None:
                self._records.append(Left(now_ns, made.epoch, made.counter))

    def _ask_for_session_if_due(self, now_ns: int, *, lacks: bool) -> None:
        """Ask for a session while cloud `lacks` one, and for a new one after the key changed."""
        if lacks:
            self._say_hello_if_due(now_ns)
            if now_ns - self._heard_ns > PATIENCE_NS:
                self._tell("no_session", SILENCE_TEXT, now_ns)
        else:
            self._hellos = 0  # the next hello has the new key
            self._say_hello_if_due(now_ns, KEY_PERIOD_NS)

    def _act(self, now_ns: int) -> None:
        """Take teleop's messages; send the command of this period or, without one, ALIVE if due.

        Repeat an emergency stop that the robot has not confirmed.
        """
        self.teleop.handle_deadline(now_ns)
        if self.teleop.outputs:
            self._take_from_teleop()
        if not self._session.epoch:
            return
        if self._alarm.sounds and (alarm := self._alarm.due(self._asked, now_ns)) is not None:
            self._relay(alarm)
        if self._loop.ready and self._setpoint is not None:
            if self._on_arrival:
                self._answer_if_due(now_ns)
            else:
                self._send_command(self._setpoint, now_ns)
        elif now_ns >= self._alive_ns:
            self._alive_ns = now_ns + ALIVE_PERIOD_NS
            self._send(Kind.ALIVE, b"")

    def _answer_if_due(self, now_ns: int) -> None:
        """Send a command, if cloud answers telemetry on its arrival and one is due."""
        is_due = self._on_arrival and self._can_answer and now_ns >= self._due_ns
        if is_due and self._setpoint is not None:
            self._due_ns = now_ns + SILENT_PERIODS * self._period_ns // 2
            self._send_command(self._setpoint, now_ns)

    def receive_datagram(self, data: Datagram, now_ns: int) -> None:
        """Handle a datagram that arrived at `now_ns` [ns]; count and drop an invalid datagram."""
        try:
            kind, epoch, counter, body = self._session.open(data)
            if kind == TELEMETRY:
                self._receive_telemetry(epoch, counter, body, now_ns)
            elif kind in KINDS:
                self._records += self.sensors.receive(kind, epoch, counter, body, now_ns)
            elif kind == Kind.ACCEPT:
                self._receive_accept(epoch, Accept(*codec.decode(Kind.ACCEPT, body)), now_ns)
            elif kind == Kind.CHALLENGE:
                self._receive_challenge(codec.decode(Kind.CHALLENGE, body)[0], now_ns)
            elif kind == Kind.BUSY:
                self._receive_busy(codec.decode(Kind.BUSY, body)[0], now_ns)
            elif kind != Kind.ALIVE:
                raise DecodeError("malformed")
        except DecodeError as error:
            self._refuse(str(error), data, now_ns)

    def _receive_challenge(self, cookie: bytes, now_ns: int) -> None:
        """Answer a challenge with a hello that has its cookie, while cloud asks for a session."""
        hello = self._handshake.answer_challenge(cookie)
        asks = self._wants_session(now_ns) or self._session.is_outdated
        if hello is not None and asks:
            self._queue(self._session.sign(Kind.HELLO, hello, self._session.handshake_key))

    def _receive_busy(self, nonce: bytes, now_ns: int) -> None:
        """Tell the user that another cloud has the session, if cloud's hello was refused."""
        if self._handshake.is_refused(nonce) and self._wants_session(now_ns):
            self.counts["busy"] += 1
            self._tell("busy", BUSY_TEXT, now_ns)

    def _refuse(self, outcome: str, data: bytes, now_ns: int) -> None:
        self.counts[outcome] += 1
        if outcome == "old_epoch" and codec.peek(data)[1] > self._session.epoch:
            self._say_hello_if_due(now_ns)  # world's ACCEPT of a new session may be lost
        elif self._wants_session(now_ns):
            self._tell_refusal(outcome, data, now_ns)

    def _note_missed(self, count: int, now_ns: int) -> None:
        self.counts["missed_periods"] += count
        if now_ns - self._late_window_ns > LATE_WINDOW_NS:
            self._late_ns, self._late_window_ns = 0, now_ns
        self._late_ns += count * self._period_ns
        if self._late_ns > LATE_NS:
            self._tell("late", LATE_TEXT, now_ns)

    def _say_hello_if_due(self, now_ns: int, period_ns: int = HELLO_PERIOD_NS) -> None:
        """Send a hello once per `period_ns`; while two keys are valid, use them in turn."""
        if now_ns < self._hello_ns + period_ns:
            return
        self._hello_ns = now_ns
        keys = self._session.ring.keys.accepted
        key = keys[self._hellos % len(keys)]
        self._hellos += 1
        if self._session.epoch == NO_EPOCH:  # the key of the last session was dropped
            self._handshake.leave()
        self._queue(self._session.sign(Kind.HELLO, self._handshake.make_hello(), key))

    def _wants_session(self, now_ns: int) -> bool:
        return self._session.epoch == NO_EPOCH or now_ns - self._heard_ns > SILENCE_NS

    def _receive_accept(self, epoch: int, accept: Accept, now_ns: int) -> None:
        asks = self._wants_session(now_ns)
        nonces = self._handshake.receive_accept(epoch, accept, asks=asks)
        if nonces is None:
            self.counts["accept_ignored"] += 1
            return
        self._session.begin(epoch, nonces, self._session.handshake_key)
        self._told.clear()
        self._window.reset()
        self.sensors.begin_session(epoch)
        self._loop.reset(now_ns)
        self._setpoint = None  # the robot may have moved; teleop sends a new one
        self._control, self._uplink_delay = None, nan
        self._asked = 0  # numbers of the previous session no longer count
        self._alarm.restart_numbers()
        self._world = accept.world_nonce.hex()
        self._clock_is_shared = accept.clock == self._identity.clock_id
        self._heard_ns = now_ns
        self._commanded_ns = NEVER_NS
        self._records.append(SessionOpened(now_ns, "cloud", epoch, "world accepted"))

    def _receive_telemetry(self, epoch: int, counter: int, body: Any, now_ns: int) -> None:
        outcome = self._window.take(counter)
        if outcome != REPEATED:  # an attacker can repeat datagrams
            self._heard_ns = now_ns
        self.counts[outcome] += 1
        used = outcome == USED
        telemetry, delay = codec.decode_telemetry(body) if type(body) is bytes else body, nan
        if self._clock_is_shared:
            delay = (now_ns - telemetry.stamp_ns - telemetry.slip_ns) * 1e-9
        if outcome != REPEATED or not self._window.is_flooded:
            echo = telemetry.echo_stamp_ns, telemetry.echo_hold_ns
            fields = now_ns, True, epoch, counter, delay, used, *echo
            is_sample = used and self._loop.gives_sample(*echo)
            self._records.append(_new(Arrival, (*fields, is_sample)))
        if self._perceiver is not None and outcome != REPEATED:
            self._perceiver.observe(telemetry.odometry, now_ns)
        if outcome == LATE:
            self._loop.observe_late(telemetry, now_ns)
        if used:
            if self.watch is not None:
                self.watch(epoch, counter, telemetry)
            self._use_telemetry(telemetry, epoch, delay, now_ns)

    def _use_telemetry(self, telemetry: Telemetry, epoch: int, delay: float, now_ns: int) -> None:
        """Give telemetry, newer than all before, to the loop and to teleop.

        `delay` is its one-way delay [s]; NaN if it is unknown.
        """
        self.telemetry = telemetry
        self._alarm.see(telemetry.guard, telemetry.mission)
        if self._start is not None and telemetry.mission >= self._start[0]:
            self._loop.expect((now_ns - self._start[1]) * 1e-9)
            self._start = None
        self._loop.observe(telemetry, now_ns)
        if self._on_arrival:
            soonest_ns = max(now_ns, self._commanded_ns + self._period_ns // 2)
            self._due_ns = min(self._due_ns, soonest_ns)
        log = self._loop.plans
        if log.plans and (followed := log.look_up(telemetry, now_ns)) is not None:
            self._records.append(followed)
        if telemetry.mission > self._asked:
            self._asked = telemetry.mission
        # The last command was made before this telemetry: it has the delay of the one before.
        known, self._uplink_delay = (self._uplink_delay, self._control), delay
        self.teleop.see(make_robot_status(telemetry, epoch, self._world, *known), now_ns)
        if self.teleop.outputs:
            self._take_from_teleop()

    def _take_from_teleop(self) -> None:
        for message in self.teleop.take_outputs():
            if not is_for_session(self._session.epoch, message):
                self.counts["words_dropped"] += 1
            elif isinstance(message, Setpoint):
                self._setpoint = message
            elif isinstance(message, OperatorRequest):
                self._relay(message)
            else:
                self._records.append(message)
                if isinstance(message, MissionEvent):
                    if message.event == "started":
                        self._loop.start_mission()
                        if self._perceiver is not None:
                            self._perceiver.begin_mission()
                    if message.event == "started" or message.event not in UNDER_WAY:
                        self._record_counts(message.stamp_ns)

    def _relay(self, request: OperatorRequest) -> None:
        """Relay an operator's request to world, or drop it; teleop repeats a dropped request.

        An emergency stop without a number (0) is never dropped: cloud numbers it and repeats it.
        Cloud drops all other requests while there is no session. Cloud also drops a START request
        before the first telemetry, and while it repeats an emergency stop.
        """
        if request.number > codec.NUMBER_MAX:  # somebody with the keys has used up the numbers
            self.counts["words_dropped"] += 1
            return
        may_start = self._loop.ready and not self._alarm.sounds
        if request.number == 0 and request.request is Request.ESTOP:
            self._alarm.sound()
            return
        if not self._session.epoch or (request.request is Request.START and not may_start):
            return
        if request.request is Request.ACKNOWLEDGE:
            self._alarm.acknowledge()
        elif request.request is Request.START and request.number > self._asked:
            self._start = request.number, self._tick_ns
        self._asked = max(self._asked, request.number)
        stamped = request._replace(basis_stamp_ns=self._loop.basis_stamp_ns)
        self._send(Kind.OPERATOR, codec.encode_operator(stamped))

    def _send_command(self, setpoint: Setpoint, now_ns: int) -> None:
        perceiver = self._perceiver
        if perceiver is not None:
            setpoint = perceiver.steer(setpoint, now_ns)
        elapsed_ns = now_ns - self._commanded_ns if self._commanded_ns >= 0 else self._period_ns
        self._commanded_ns = now_ns
        epoch, counter = self._session.epoch, self._session.next_counter(COMMAND)
        compute = self._compute
        if compute is not None:
            compute.begin()
        command, control = self._loop.command(setpoint, now_ns, elapsed_ns * 1e-9, epoch, counter)
        sent_ns = now_ns if compute is None else now_ns + compute.end(now_ns)
        datagram = None if command is None else self._make_datagram(COMMAND, command)
        if datagram is not None:
            self._quiet_ns = sent_ns + ALIVE_PERIOD_NS
        elif now_ns >= self._quiet_ns:
            self._quiet_ns = now_ns + ALIVE_PERIOD_NS
            self._send(Kind.ALIVE, b"")
        if compute is not None:
            self._unsent = sent_ns, datagram
        elif datagram is not None:
            self._queue(datagram)
        self._records.append(control)
        self._control = control
        if perceiver is not None:
            perceiver.note_command(setpoint, epoch, control.counter, now_ns)

    def _record_counts(self, now_ns: int) -> None:
        self.count_sent()
        if self._perceiver is not None:
            self.counts |= self._perceiver.counts
        for name, count in sorted(self.counts.items()):
            self._records.append(Counted(now_ns, "cloud", name, count))
