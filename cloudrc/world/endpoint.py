# SPDX-License-Identifier: Apache-2.0

"""World's end of the tunnel: receive commands, fly the robot and send telemetry.

A datagram takes effect after all steps of the simulation that are due before its arrival. The
result therefore does not depend on when the driver (the program that calls this class) wakes up.

World's clock follows the machine's monotonic clock, but may fall behind. After a stall of the
process, world simulates at most 50 ms of the lost time, and its clock never jumps ahead. The
remaining lag stays for good; it is called the slip. The guard runs in every simulated step.

World numbers the sessions; the number is the session's epoch. A new epoch begins when a cloud gets
a session, and when a mission starts from the spawn, the robot's initial place in the scene.
"""

from __future__ import annotations

from math import hypot, isnan, nan

from cloudrc.physics.geometry.rays import scan_record
from cloudrc.physics.geometry.scene import is_obstacle
from cloudrc.physics.sim.scan import Scanner
from cloudrc.physics.sim.simulator import Simulator
from cloudrc.physics.sim.target import MovingTarget
from cloudrc.results.metrics.definitions import real_time_factor
from cloudrc.wire.messages import (
    NEVER_NS,
    Command,
    Datagram,
    GuardState,
    Odometry,
    OperatorRequest,
    Request,
    Start,
    Telemetry,
)
from cloudrc.wire.records import (
    REAL_TIME_FACTOR_MIN,
    Arrival,
    CommandApplied,
    ContactForce,
    Counted,
    EnergyUsed,
    FrameSent,
    GroundTruth,
    SensorRead,
    SessionOpened,
    TelemetrySent,
)
from cloudrc.wire.tunnel import codec
from cloudrc.wire.tunnel.codec import DecodeError, Direction, Hello, Kind
from cloudrc.wire.tunnel.end import Identity, TunnelEnd
from cloudrc.wire.tunnel.handshake import ServerHandshake
from cloudrc.wire.tunnel.window import REPEATED, USED
from cloudrc.world.frame_source import FrameSource
from cloudrc.world.robot import STEP_NS, Robot
from cloudrc.world.sensors import Sensors

START_AGE_MAX_NS = 1_000_000_000
"""Largest accepted age of a start request [ns]; a larger age limit for commands applies instead.
The age counts from the stamp of the newest odometry that cloud had when it sent the request."""
ODOMETRY_PERIOD_NS = 10_000_000
"""Default time between two odometry samples, and longest time between two records of the true
state [ns]. Source: docs/reference/plant.md, "Odometry"."""
CATCH_UP_NS = 50_000_000
"""Largest lag of world's clock that world makes up after a stall [ns]; further lag stays."""
COUNT_PERIOD_NS = 1_000_000_000
"""Time between two records of the counters [ns]."""
SLOW_TEXT = "simulated time is slower than real time; give world more processor time"
TRACK = GuardState.TRACK  # looking up a member of an enum is slow
COMMAND, TELEMETRY = int(Kind.COMMAND), int(Kind.TELEMETRY)  # looked up in every period
SCAN, FRAME = int(Kind.SCAN), int(Kind.FRAME)
NEVER_DUE_NS = 1 << 63
"""Time of the next scan or picture if there is none [ns]: later than any clock shows."""
_new = tuple.__new__  # makes a named tuple in half the time of its own constructor


class WorldEndpoint(TunnelEnd):
    """The robot's end of the tunnel: an `Endpoint` that flies the robot by cloud's commands."""

    def __init__(
        self,
        robot: Robot,
        sensors: Sensors,
        identity: Identity,
        *,
        newest_wins: bool,
        odometry_period_ns: int = ODOMETRY_PERIOD_NS,
        start_ns: int = 0,
        scanner: Scanner | None = None,
        frame_source: FrameSource | None = None,
        target: MovingTarget | None = None,
    ) -> None:
        """Connect a robot that is switched off to the tunnel; there is no session yet.

        With `newest_wins`, a command that arrives after a newer command is dropped.
        `odometry_period_ns` is the time between two odometry samples [ns], a multiple of the step.
        `start_ns` is the present time on the monotonic clock [ns]. Without a `scanner`, no scans
        are sent, and without a `frame_source` no pictures. `target` is a body of the scene that
        moves.
        """
        super().__init__(identity, Direction.UPLINK, robot.guard.counts, newest_wins=newest_wins)
        self.robot, self._sensors = robot, sensors
        self._run_robot = robot.advance if robot.name else robot.run  # only a user's code may fail
        self._tick_ns, self._slip_ns = start_ns, 0  # world's clock and its lag
        self._command_age_max_ns = age_max_ns = robot.guard.command_age_max_ns
        self._door = ServerHandshake(self._session, identity.nonce, identity.clock_id, age_max_ns)
        # When the next sample, telemetry, and the next sample, scan or picture are due.
        self._sample_ns = self._odometry_ns = self._look_ns = start_ns
        self._odometry_period_ns = odometry_period_ns
        self._sample_period_ns = min(odometry_period_ns, ODOMETRY_PERIOD_NS)
        self._count_ns, self._session_ns = start_ns + COUNT_PERIOD_NS, start_ns
        self._scanner, self._frame_source, self._target = scanner, frame_source, target
        self._senses = scanner is not None or frame_source is not None
        self._scans = self._frames = 0  # that were due in this session
        self._scan_ns = self._frame_ns = NEVER_DUE_NS
        self._counted_slip_ns: int | None = None
        self._waiting: tuple[int, int, Command] | None = None
        self._stalled_wake_ns = self._echo_stamp_ns = self._applied_ns = NEVER_NS
        self._number = 0  # of the newest operator request carried out in this session
        # Of the mission that was started last: its number, waypoints reached as reported by the
        # operator, contacts with obstacles, name of the body that the mission has to touch ("" for
        # none), and speed of the first touch.
        self._mission_id = self._reached = self._obstacles = 0
        self._touch_speed, self._touch = nan, ""
        self._shows = bool(robot.simulator.sensors)
        self._recorded = _recorded(robot.simulator)

    @property
    def slip_ns(self) -> int:
        """Lag of world's clock behind the machine's monotonic clock [ns]."""
        return self._slip_ns

    def next_deadline_ns(self) -> int:
        """Return when the next sample, scan or picture is due [ns], monotonic clock."""
        return self._look_ns + self._slip_ns

    def handle_deadline(self, now_ns: int) -> None:
        """Simulate up to `now_ns` [ns]; send the telemetry that is due."""
        self._session.follow_keys()
        self._advance(self._follow(now_ns), samples=True)
        if self._frame_source is not None:
            self._send_frame(self._frame_source)

    def receive_datagram(self, data: Datagram, now_ns: int) -> None:
        """Handle a datagram that arrived at `now_ns` [ns]; count and drop an invalid datagram."""
        world_ns = self._follow(now_ns)
        try:
            kind, epoch, counter, body = self._session.open(data)
            if kind == COMMAND:
                command = codec.decode_command(body) if type(body) is bytes else body
                self._receive_command(epoch, counter, command, now_ns, world_ns)
                if self._frame_source is not None:
                    self._send_frame(self._frame_source)
            elif kind == Kind.HELLO:
                self._advance(world_ns)
                self._receive_hello(Hello(*codec.decode(Kind.HELLO, body)), counter, now_ns)
            else:
                self._door.accept_once(kind, counter, now_ns)
                if kind == Kind.OPERATOR:
                    self._advance(world_ns)
                    self._receive_operator(codec.decode_operator(body), now_ns)
        except DecodeError as error:
            self.counts[str(error)] += 1
            if not self._session.epoch:
                self._tell_refusal(str(error), data, world_ns)

    def _follow(self, now_ns: int) -> int:
        """Return world's time at `now_ns` [ns, monotonic clock]: `now_ns` minus the slip.

        If the simulation lags by more than CATCH_UP_NS, add the excess to the slip. If it lags by
        more than the largest age of a command, world has stalled, and datagrams read at this
        `now_ns` may have waited in the socket. Then store `now_ns`: they are stale.
        """
        world_ns = now_ns - self._slip_ns
        behind_ns = world_ns - self._tick_ns
        if behind_ns > self._command_age_max_ns:
            self._stalled_wake_ns = now_ns
            self.counts["stalls"] += 1
        if behind_ns <= CATCH_UP_NS:
            return world_ns
        self._slip_ns += behind_ns - CATCH_UP_NS
        return now_ns - self._slip_ns

    def _advance(self, until_ns: int, *, samples: bool = False) -> None:
        """Simulate all steps that begin before `until_ns` [ns], world's clock.

        With `samples`, also take the sample of the true state, scan and picture due at `until_ns`.

        If an earlier call has taken this sample, also simulate the step that begins at `until_ns`.
        So a datagram that arrives at the time of a sample acts from the next step on.
        """
        tick_ns = self._tick_ns
        if until_ns == tick_ns == self._sample_ns - self._sample_period_ns:
            until_ns += 1
        if self._waiting is not None and (tick_ns < until_ns or samples):
            self._apply(tick_ns)
        while tick_ns < until_ns:
            if tick_ns >= self._look_ns:
                self._look(tick_ns)
            look_ns = self._look_ns
            stop_ns = look_ns if look_ns < until_ns else until_ns
            tick_ns = self._tick_ns = self._run_robot(tick_ns, stop_ns)
        if samples and tick_ns == self._look_ns:
            self._look(tick_ns)

    def _look(self, now_ns: int) -> None:
        """Take what is due."""
        if self._senses:
            self._sample_and_sense(now_ns)
        else:
            self._sample(now_ns)

    def _apply(self, now_ns: int) -> None:
        assert self._waiting is not None
        epoch, counter, command = self._waiting
        self._waiting = None
        if self.robot.guard.state is not TRACK:  # the mission has just ended or stopped
            return
        echo_ns, basis_ns, _, velocity, _, plan, planned_ns = command
        if plan:
            velocity = command.velocity_at(now_ns)
        self._echo_stamp_ns, self._applied_ns = echo_ns, now_ns
        applied = (now_ns, epoch, counter, basis_ns, velocity, planned_ns)
        self._records.append(_new(CommandApplied, applied))

    def _sample(self, now_ns: int) -> None:
        """Record the true state and new guard changes and contacts; send telemetry if it is due."""
        robot, records = self.robot, self._records
        simulator, guard = robot.simulator, robot.guard
        truth = simulator.truth(now_ns)
        shown = simulator.read_sensors() if self._shows else ()
        records.append(_new(GroundTruth, (now_ns, truth, guard.reference)))
        if self._target is not None:
            records.append(self._target.observe(now_ns))
        if (meter := simulator.meter) is not None:
            meter.sample()
            if guard.changes or now_ns >= self._count_ns:
                records.append(EnergyUsed(now_ns, meter.read(self._sample_period_ns * 1e-9)))
        if (force := simulator.take_contact_force()) is not None:
            records.append(_new(ContactForce, (now_ns, *force, simulator.force_sensor)))
        for number, name, unit in self._recorded:
            records.append(_new(SensorRead, (now_ns, name, unit, shown[number])))
        if guard.changes or simulator.touches or robot.failure is not None:
            self._record_events(now_ns)
        if now_ns >= self._odometry_ns:
            self._odometry_ns += self._odometry_period_ns
            if epoch := self._session.epoch:
                self._send_telemetry(now_ns, epoch, truth, shown)
        if now_ns >= self._count_ns:
            self._record_counts(now_ns)
        self._sample_ns += self._sample_period_ns
        self._look_ns = self._sample_ns

    def _sample_and_sense(self, now_ns: int) -> None:
        """Take the sample, the scan and the picture, those that are due."""
        if now_ns >= self._sample_ns:
            self._sample(now_ns)
        if self._scanner is not None and now_ns >= self._scan_ns:
            self._scans += 1
            self._scan_ns = self._due_ns(self._scans, self._scanner.config.rate_hz)
            self._scan(self._scanner, now_ns)
        if self._frame_source is not None and now_ns >= self._frame_ns:
            self._frames += 1
            self._frame_ns = self._due_ns(self._frames, self._frame_source.rate_hz)
            if self._target is not None:
                self._target.move(now_ns)
            self._frame_source.take(now_ns)
            self._send_frame(self._frame_source)
        self._look_ns = min(self._sample_ns, self._scan_ns, self._frame_ns)

    def _due_ns(self, number: int, rate_hz: int) -> int:
        """Return the first physics step of a period of the session [ns]."""
        return self._session_ns + -(-number * 1_000_000_000 // (rate_hz * STEP_NS)) * STEP_NS

    def _send_frame(self, source: FrameSource) -> None:
        """Send the frame that is ready, if there is one, a fragment per datagram."""
        if (frame := source.finished()) is None:
            return
        counter, fragments = self._session.next_counter(FRAME), [*frame.fragments()]
        for fragment in fragments:
            self._queue(self._make_datagram(FRAME, fragment))
        which = self._tick_ns, self._session.epoch, frame.number, frame.stamp_ns, frame.encode_ns
        size = len(frame.data)
        sent = FrameSent(*which, counter, len(fragments), size, frame.key, frame.psnr)
        self._records.append(sent)

    def _scan(self, scanner: Scanner, now_ns: int) -> None:
        """Scan and send the distances."""
        scan = scanner.measure(now_ns)
        epoch, counter = self._session.epoch, self._session.next_counter(SCAN)
        self._queue(self._make_datagram(SCAN, scan))
        self._records.append(scan_record(scanner.config, epoch, counter, scan))

    def _record_events(self, now_ns: int) -> None:
        """Record a failure of the onboard controller, changes of the guard's state and contacts."""
        simulator, guard, records = self.robot.simulator, self.robot.guard, self._records
        if (failure := self.robot.failure) is not None:
            self._tell(failure.code, failure.text, failure.stamp_ns, failure.traceback)
            self.robot.failure = None
        if guard.changes:
            records += guard.take_changes()
        if simulator.touches:
            for touch in simulator.take_contacts():
                records.append(touch._replace(stamp_ns=now_ns))
                self._obstacles += is_obstacle(touch.body, touch=self._touch)
                if touch.body == self._touch and touch.by_probe and isnan(self._touch_speed):
                    self._touch_speed = hypot(*touch.touch_velocity)

    def _send_telemetry(
        self, now_ns: int, epoch: int, truth: Odometry, shown: tuple[float, ...]
    ) -> None:
        """Send telemetry with the measured `truth` and the sensors' values `shown`; record it."""
        guard = self.robot.guard
        known = (
            now_ns,
            truth if self._sensors.exact else self._sensors.measure(truth),
            shown,
            self._echo_stamp_ns,
            now_ns - self._applied_ns if self._applied_ns >= 0 else 0,
            self._slip_ns,
            self._number,
            guard.state,
            self._obstacles,
            self._touch_speed,
            self._mission_id,
            self._reached,
            guard.cause,
        )
        telemetry = _new(Telemetry, known)
        counter = self._session.next_counter(TELEMETRY)
        self._queue(self._make_datagram(TELEMETRY, telemetry))
        self._records.append(_new(TelemetrySent, (now_ns, epoch, counter, telemetry)))

    def _record_counts(self, now_ns: int) -> None:
        """Record the counters of world and guard; report a slow simulation once per session."""
        before_ns = self._counted_slip_ns
        self._count_ns, self._counted_slip_ns = self._count_ns + COUNT_PERIOD_NS, self._slip_ns
        self.count_sent()
        for name, count in sorted(self.counts.items()):
            self._records.append(Counted(now_ns, "world", name, count))
        lost_ns = self._slip_ns - (before_ns or 0)
        is_slow = real_time_factor(COUNT_PERIOD_NS, lost_ns) < REAL_TIME_FACTOR_MIN
        if before_ns is not None and is_slow:
            self._tell("late", SLOW_TEXT, now_ns)

    def _receive_hello(self, hello: Hello, counter: int, now_ns: int) -> None:
        if now_ns == self._stalled_wake_ns:
            raise DecodeError("stale")
        answer = self._door.receive_hello(hello, counter, now_ns)
        self.counts[answer.outcome] += 1
        if answer.opened:
            self._clock_is_shared = hello.clock == self._identity.clock_id
            self._number = 0
            self._begin_epoch("cloud said hello")
        for datagram in answer.datagrams:
            self._queue(datagram)

    def _begin_epoch(self, cause: str) -> None:
        self._window.reset()
        self.robot.guard.forget_commands()
        self._waiting = None
        self._echo_stamp_ns = self._applied_ns = NEVER_NS
        self._told.clear()
        epoch, now_ns = self._session.epoch, self._tick_ns
        self._scans, self._frames, self._session_ns = 0, 0, now_ns
        if self._scanner is not None:
            self._scan_ns = now_ns
        if self._frame_source is not None:
            self._frame_source.begin_session()
            self._frame_ns = now_ns
        if self._senses:
            self._look_ns = min(self._sample_ns, now_ns)
        self._records.append(SessionOpened(now_ns, "world", epoch, cause))
        for observer in self.robot.observers:
            observer.see_session(now_ns)

    def _receive_operator(self, request: OperatorRequest, now_ns: int) -> None:
        """Carry out an operator request; ignore repeated and old requests.

        Raise the DecodeError "stale" for a START request if the odometry that it is based on is too
        old, or if the request may have waited in the socket during a stall. Raise "future" if this
        odometry is later than world's clock.
        """
        starts = request.request is Request.START
        is_progress = request.request is Request.PROGRESS
        if not is_progress:
            if request.number <= self._number:
                return
            if starts and not self._may_start(request, now_ns):
                return
            self._number = request.number
        if starts:
            if request.mission_id != self._mission_id or request.start is Start.SPAWN:
                self._mission_id, self._reached = request.mission_id, 0
                self._obstacles, self._touch_speed = 0, nan
            self._touch = request.touch
        if request.mission_id == self._mission_id:  # stored on board for a restarted cloud
            self._reached = max(self._reached, request.reached)
        if not is_progress:
            self._obey(request, now_ns)

    def _may_start(self, request: OperatorRequest, now_ns: int) -> bool:
        """Return whether the robot may start a mission; count a refusal, raise DecodeErrors."""
        age_ns = self._tick_ns - request.basis_stamp_ns
        age_max_ns = max(START_AGE_MAX_NS, self._command_age_max_ns)
        if now_ns == self._stalled_wake_ns or age_ns > age_max_ns:
            raise DecodeError("stale")
        if age_ns < 0:
            raise DecodeError("future")
        if not self.robot.guard.latched:
            return True
        # Telemetry does not confirm this request: the operator has to acknowledge first.
        self.counts["start_refused"] += 1
        return False

    def _obey(self, request: OperatorRequest, now_ns: int) -> None:
        """Carry out a request other than PROGRESS, and inform the observers."""
        guard, tick_ns = self.robot.guard, self._tick_ns
        match request.request:
            case Request.END:
                guard.end_mission(tick_ns)
            case Request.ESTOP:
                guard.stop(tick_ns)
            case Request.ACKNOWLEDGE:
                guard.acknowledge(tick_ns)
            case Request.START:
                if request.start is Start.SPAWN:
                    self.robot.start_again(tick_ns, "mission starts from spawn")
                    self._queue(self._door.begin_next_epoch(now_ns))
                    self._begin_epoch("mission starts from spawn")
                guard.start_mission(tick_ns)
                if self._target is not None:
                    self._target.begin(tick_ns)
        for observer in self.robot.observers:
            observer.see_request(request, tick_ns)

    def _receive_command(
        self, epoch: int, counter: int, command: Command, now_ns: int, world_ns: int
    ) -> None:
        """Simulate up to `world_ns` [ns], and offer a command to the guard."""
        robot = self.robot
        outcome = self._window.take(counter, bool(command.plan))
        if outcome != REPEATED:
            self._door.hear(now_ns)
        if outcome == USED:
            self._advance(world_ns)
            if now_ns == self._stalled_wake_ns:  # it may have waited in the socket
                outcome = "stale"
            else:
                rejection = robot.guard.accept_command(command, self._tick_ns)
                for observer in robot.observers:
                    observer.see_command(command, rejection, self._tick_ns)
                outcome = rejection or USED
        used = outcome == USED
        delay = (now_ns - command.stamp_ns) * 1e-9 if self._clock_is_shared else nan
        if outcome != REPEATED or not self._window.is_flooded:
            fields = world_ns, False, epoch, counter, delay, used, NEVER_NS, 0, False
            self._records.append(_new(Arrival, fields))
        if used and robot.guard.state is TRACK:
            self._waiting = (epoch, counter, command)
        self.counts[outcome] += 1


def _recorded(simulator: Simulator) -> list[tuple[int, str, str]]:
    """Return number, name and unit of each sensor but that of the contact force.

    That one has a record of its own.
    """
    return [
        (number, name, unit)
        for number, (name, unit, _) in enumerate(simulator.sensors)
        if (name, unit) != simulator.force_sensor
    ]
