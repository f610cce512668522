"""World's end of the tunnel: commands come in, the robot flies, telemetry leaves.

Time only moves in `_advance`: before anything that comes in has an effect, the ticks before it are
run, so the result does not depend on when a driver wakes up. World alone hands out epochs: a cloud
that gets authority gets a new one, and so does a mission that starts from the spawn.
"""

from __future__ import annotations

from collections import defaultdict
from math import nan

from cloudrc.messages import (
    NEVER_NS,
    Command,
    GuardState,
    Odometry,
    OperatorRequest,
    Start,
    Telemetry,
)
from cloudrc.records import (
    Arrival,
    CommandApplied,
    Contact,
    Counted,
    GroundTruth,
    Record,
    SessionOpened,
    TelemetrySent,
)
from cloudrc.tunnel import codec
from cloudrc.tunnel.channel import REPEATED, USED, Channel
from cloudrc.tunnel.codec import DecodeError, Direction, Hello, Kind
from cloudrc.tunnel.handshake import NO_EPOCH, Complaints, Door
from cloudrc.tunnel.session import make_session
from cloudrc.world.clock import CATCH_UP_NS, SimulationClock
from cloudrc.world.identity import WorldIdentity as WorldIdentity
from cloudrc.world.orders import Orders
from cloudrc.world.pace import Pace
from cloudrc.world.robot import Robot
from cloudrc.world.sensors import Sensors

ODOMETRY_PERIOD_NS = 10_000_000
"""Time between two odometry samples [ns]. Source: docs/reference/plant.md, "Odometry"."""
COUNT_PERIOD_NS = TEND_PERIOD_NS = 1_000_000_000
TRACK, HOLD = GuardState.TRACK, GuardState.HOLD  # an enum's member is slow to look up
COMMAND, TELEMETRY = int(Kind.COMMAND), int(Kind.TELEMETRY)  # looked up in every period
_new = tuple.__new__  # of a named tuple: the constructor of its class takes twice the time


class WorldEndpoint:
    """The robot's end of the tunnel; an `Endpoint`."""

    def __init__(
        self,
        robot: Robot,
        sensors: Sensors,
        identity: WorldIdentity,
        *,
        newest_wins: bool,
        command_age_max_ns: int,
        start_ns: int = 0,
    ) -> None:
        """Begin with the robot on the ground at its spawn.

        Args:
            robot: At its spawn, its guard in GROUND.
            sensors: What odometry sees.
            identity: Who this end is.
            newest_wins: Policy for late commands.
            command_age_max_ns: What may have waited longer in the socket is stale [ns].
            start_ns: The monotonic clock now [ns].
        """
        self.robot, self._sensors, self._identity = robot, sensors, identity
        self._clock, self._pace = SimulationClock(start_ns), Pace()
        self._session = make_session(Direction.UPLINK, identity.ring, start_ns)
        self._door = Door(self._session, identity, age_max_ns=command_age_max_ns)
        self._channel = Channel(newest_wins)
        self._complaints = Complaints()
        self._command_age_max_ns = command_age_max_ns
        self._clock_is_shared = False
        self._stalled_wake_ns = NEVER_NS
        self._odometry_ns = start_ns
        self._count_ns = start_ns + COUNT_PERIOD_NS
        self._tend_ns = start_ns + TEND_PERIOD_NS
        self._waiting: tuple[int, int, Command] | None = None
        self._echo_stamp_ns = self._applied_ns = NEVER_NS
        self._datagrams: list[bytes] = []
        self._records: list[Record] = []
        self._counts: defaultdict[str, int] = defaultdict(int)
        self._orders = Orders(robot.guard, self._counts, command_age_max_ns)

    @property
    def slip_ns(self) -> int:
        """By how much world's clock lags the monotonic one [ns]."""
        return self._clock.slip_ns

    @property
    def sealed(self) -> bool:
        """See `Endpoint`."""
        return self._session.sealed

    def next_deadline_ns(self) -> int:
        """When the next odometry is due [ns], monotonic clock."""
        return self._odometry_ns + self._clock.slip_ns

    def handle_deadline(self, now_ns: int) -> None:
        """Run every tick up to and including `now_ns`; odometry leaves on its way."""
        self._advance(self._follow(now_ns) + 1)
        if now_ns >= self._tend_ns:  # by the machine's clock: world's may lag
            self._tend_ns = now_ns + TEND_PERIOD_NS
            self._greet(self._session.tend(now_ns))

    def take_datagrams(self) -> list[bytes]:
        """Hand over the datagrams to send."""
        datagrams, self._datagrams = self._datagrams, []
        return datagrams

    def take_records(self) -> list[Record]:
        """Hand over the records since the last call."""
        records, self._records = self._records, []
        return records

    def receive_datagram(self, data: bytes, now_ns: int) -> None:
        """Take in one datagram; what is not valid is counted and dropped."""
        world_ns = self._follow(now_ns)
        try:
            kind, _, epoch, counter, body = self._session.open(data)
            if kind == COMMAND:
                self._receive_command(epoch, counter, body, now_ns, world_ns)
            elif kind == Kind.HELLO:
                self._advance(world_ns)
                self._receive_hello(codec.decode_hello(body), counter, now_ns)
            else:
                self._door.admit(kind, counter, now_ns)
                if kind == Kind.OPERATOR:
                    self._advance(world_ns)
                    self._receive_operator(codec.decode_operator(body), now_ns)
        except DecodeError as error:
            self._counts[str(error)] += 1
            if not self._session.epoch:
                self._records += self._complaints.about(str(error), data, world_ns)

    def _follow(self, now_ns: int) -> int:
        """World time at a wake; remembers a wake after a stall, whose datagrams have waited."""
        world_ns = now_ns - self._clock.slip_ns
        behind_ns = world_ns - self._clock.tick_ns
        if behind_ns > self._command_age_max_ns:
            self._stalled_wake_ns = now_ns
            self._counts["stalls"] += 1
        return self._clock.follow(now_ns) if behind_ns > CATCH_UP_NS else world_ns

    def _advance(self, until_ns: int) -> None:
        """Run all ticks before `until_ns` [world's clock]."""
        clock, tick_ns = self._clock, self._clock.tick_ns
        if tick_ns < until_ns and self._waiting is not None:
            self._apply(tick_ns)
        while tick_ns < until_ns:
            if tick_ns >= self._odometry_ns:
                self._send_telemetry(tick_ns)
            odometry_ns = self._odometry_ns
            stop_ns = odometry_ns if odometry_ns < until_ns else until_ns
            tick_ns = clock.tick_ns = self.robot.run(tick_ns, stop_ns)

    def _apply(self, now_ns: int) -> None:
        """The waiting command reaches the low-level controller with this tick."""
        assert self._waiting is not None
        epoch, counter, command = self._waiting
        self._waiting = None
        if self.robot.guard.state is not TRACK:  # ended or stopped in the same wake
            return
        echo_ns, basis_ns, _, velocity, _ = command
        self._echo_stamp_ns, self._applied_ns = echo_ns, now_ns
        self._records.append(_new(CommandApplied, (now_ns, epoch, counter, basis_ns, velocity)))

    def _send_telemetry(self, now_ns: int) -> None:
        """Measure, tell cloud, and note down the truth."""
        simulator, guard, records = self.robot.simulator, self.robot.guard, self._records
        orders = self._orders
        tip_force = simulator.tip_force()
        position, orientation, velocity, rate, _ = simulator.readings
        truth = _new(Odometry, (now_ns, position, orientation, velocity, rate))
        records.append(_new(GroundTruth, (now_ns, truth, tip_force, guard.reference)))
        if guard.changes:
            records += guard.take_changes()
        if simulator.touches:
            for touch in simulator.take_contacts():
                records.append(Contact(now_ns, **touch._asdict()))
                self._orders.touches.note(touch)
        if epoch := self._session.epoch:
            known = (
                now_ns,
                self._sensors.measure(truth),
                tip_force,
                self._echo_stamp_ns,
                now_ns - self._applied_ns if self._applied_ns >= 0 else 0,
                self._clock.slip_ns,
                orders.number,
                guard.state,
                orders.touches.pipes,
                orders.touches.speed,
                orders.mission_id,
                orders.reached,
                guard.cause,
            )
            telemetry = _new(Telemetry, known)
            counter = self._session.next_counter(TELEMETRY)
            self._send(TELEMETRY, codec.encode_telemetry(telemetry))
            records.append(_new(TelemetrySent, (now_ns, epoch, counter, telemetry)))
        if now_ns >= self._count_ns:
            self._count_ns += COUNT_PERIOD_NS
            self._counts["held_seconds"] += guard.armed and guard.state is HOLD
            for name, count in sorted((self._counts | guard.counts).items()):
                records.append(Counted(now_ns, "world", name, count))
            records += self._pace.look(now_ns, self._clock.slip_ns)
        self._odometry_ns += ODOMETRY_PERIOD_NS

    def _receive_hello(self, hello: Hello, counter: int, now_ns: int) -> None:
        """Answer as the door says; what waited through a stall is too old to decide by."""
        if now_ns == self._stalled_wake_ns:
            raise DecodeError("stale")
        answer = self._door.knock(hello, counter, now_ns)
        self._counts[answer.outcome] += 1
        if not answer.datagrams:
            self._has_epoch()
        if answer.opened:
            self._clock_is_shared = self._door.shares_clock
            self._orders.number = 0
            self._begin_epoch("cloud said hello")
        self._greet(answer.datagrams)

    def _has_epoch(self) -> bool:
        """Say whether an epoch can begin; if not, the user is told."""
        ready = self._door.ready
        if not ready:
            self._records += self._complaints.say("epochs", NO_EPOCH, self._clock.tick_ns)
        return ready

    def _begin_epoch(self, cause: str) -> None:
        """Everything that belongs to the old epoch is forgotten."""
        self._channel.reset()
        self.robot.guard.forget_commands()
        self._waiting = None
        self._echo_stamp_ns = self._applied_ns = NEVER_NS
        self._complaints.forget()
        epoch, now_ns = self._session.epoch, self._clock.tick_ns
        self._records.append(SessionOpened(now_ns, "world", epoch, cause))

    def _receive_operator(self, request: OperatorRequest, now_ns: int) -> None:
        """Do as the operator asks; a mission from the spawn begins an epoch of its own."""
        tick_ns, waited = self._clock.tick_ns, now_ns == self._stalled_wake_ns
        if not self._orders.obey(request, tick_ns, waited=waited, has_epoch=self._has_epoch):
            return
        if request.start is Start.SPAWN:
            self.robot.put_on_ground(tick_ns, "mission starts from spawn")
            self._greet([self._door.move_on(now_ns)])
            self._begin_epoch("mission starts from spawn")
        self.robot.guard.start_mission(tick_ns)

    def _receive_command(
        self, epoch: int, counter: int, body: bytes, now_ns: int, world_ns: int
    ) -> None:
        """Whatever arrives for this epoch is noted; the newest is offered to the guard."""
        command, guard = codec.decode_command(body), self.robot.guard
        outcome = self._channel.take(counter)
        if outcome != REPEATED:
            self._door.hear(now_ns)
        if outcome == USED:
            self._advance(world_ns)
            stalled = now_ns == self._stalled_wake_ns
            outcome = "stale" if stalled else guard.offer(command, self._clock.tick_ns) or USED
        used = outcome == USED
        delay = (now_ns - command.stamp_ns) * 1e-9 if self._clock_is_shared else nan
        if outcome != REPEATED or not self._channel.is_flooded:
            self._records.append(_new(Arrival, (world_ns, False, epoch, counter, delay, used)))
        if used and guard.state is TRACK:
            self._waiting = (epoch, counter, command)
        self._counts[outcome] += 1

    def _send(self, kind: int, body: bytes) -> None:
        self._datagrams.append(self._session.seal(kind, body))
        self._counts["sent"] += 1

    def _greet(self, datagrams: list[bytes]) -> None:
        self._datagrams += datagrams
        self._counts["sent"] += len(datagrams)
