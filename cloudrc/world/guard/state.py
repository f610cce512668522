"""The guard: between the tunnel and the low-level controller, it decides what may be flown.

Commands and operator requests come in; a velocity reference comes out, every 2 ms. It trusts its
own clock and its own sensors only, and assumes that the cloud may say anything.

                 fresh command of a         command too old, mission over,
                  started mission                   new session
        GROUND -------------------> TRACK ------------------------------> HOLD
          ^                          | ^                                  | |
          |                          | +----------------------------------+ |
          | acknowledged             |     10 fresh commands within 500 ms  | after 60 s, if a
          | after touch-down         |                                      | mission is on
          |                          |   5 impossible commands within 1 s   |
          +------------------------ LAND <----------------------------------+

ESTOP is reached from everywhere by the operator's word, and by a hit: what has flown into something
at speed, or turned over, is thrown about by its rotors. It is left for GROUND by the
acknowledgement. LAND acknowledged in the air becomes HOLD; on something or low above it, GROUND, at
touch-down. Both end the mission: only a start arms again. HOLD before the robot has left the ground
is GROUND: its rotors stop, the mission goes on, for 60 s without the cloud as in HOLD.

A command is fresh while its *basis*, the odometry it was computed from, is at most
`command_age_max` old. HOLD after a mission's end lasts as long as the operator likes: there a robot
waits for the next one. HOLD within a mission does not: who should end it may be gone.

How the guard feels a hit: readings in, out comes what tells that the robot has met something.

The guard knows neither pipes nor board. A robot that has been flown into one at speed needs up to a
second to get its attitude back, and meanwhile its rotors push it wherever they point, faster and
faster; without them it falls, and lies within a stretch that can be told before. None of this
happens to a robot that touches nothing, whatever it is commanded: the limits are beyond that.
"""

from __future__ import annotations

from collections import Counter, deque
from math import inf

from cloudrc.messages import NEVER_NS, ZERO, Cause, Command, GuardState, Vector
from cloudrc.records import GuardChange
from cloudrc.world.guard import limits as rules
from cloudrc.world.guard.hold import Descent, Rest, TakeOff
from cloudrc.world.guard.limits import RANGE, Limits
from cloudrc.world.readings import Readings

UPSET = 0.2
"""Cosine of the tilt; the worst commands get to 0.4 without a hit [1]."""
SPIN_MAX = 3.0
"""Yaw rate [rad/s]; no command asks for it."""
TUMBLE_MAX = 7.0
"""Rate of roll and pitch [rad/s]; the worst commands get to 5.4 without a hit."""
JOLT, PULL = 0.8, 40.0e-9
"""How much a component of the velocity changes at once [m/s]: a hasty touch of the board takes off
0.5. The rotors add this in time [m/s per ns]."""


class Hits:
    """Compares what is sensed now with what was sensed last."""

    def __init__(self) -> None:
        """Begin with nothing to compare with."""
        self.forget()

    def forget(self) -> None:
        """What comes next is another flight."""
        self._velocity, self._seen_ns = ZERO, NEVER_NS

    def felt(self, now_ns: int, readings: Readings) -> Cause | None:
        """Say what has befallen the robot since the last call; None if nothing has.

        Args:
            now_ns: World's clock [ns].
            readings: Of the sensors on board.
        """
        _, _, (vx, vy, vz), (p, q, r), axes = readings
        (ux, uy, uz), seen_ns = self._velocity, self._seen_ns
        self._velocity, self._seen_ns = readings.velocity, now_ns
        if axes[8] < UPSET:
            return Cause.OVERTURNED
        if abs(r) > SPIN_MAX or p * p + q * q > TUMBLE_MAX * TUMBLE_MAX:
            return Cause.SPUN
        most = JOLT + PULL * (now_ns - seen_ns)
        if seen_ns != NEVER_NS and (
            abs(vx - ux) > most or abs(vy - uy) > most or abs(vz - uz) > most
        ):
            return Cause.JOLTED
        return None


GROUND, TRACK, HOLD, LAND, ESTOP = GuardState  # an enum's member is slow to look up

RESUME_COMMANDS = 10
RESUME_NS = 500_000_000
"""RESUME_COMMANDS fresh commands within this time end a HOLD [ns].
Source: docs/reference/plant.md, "Leaving HOLD"."""
SETTLE_NS = 1_000_000_000
"""Least time from one HOLD to the next, and from one TRACK to the next [ns].
Source: docs/reference/plant.md, "Settling time"; docs/reference/faults.md, "F5"."""
INVALID_COMMANDS = 5
IMPOSSIBLE = f"{INVALID_COMMANDS} impossible commands within 1 s"
INVALID_NS = 1_000_000_000
"""INVALID_COMMANDS impossible commands within this time end in LAND [ns].
Source: docs/reference/faults.md, "F23"."""


class Guard:
    """A state machine on world's clock; starts in GROUND, where no command is flown.

    Attributes:
        state: Where it is.
        cause: Why; of one that has touched down in LAND, why it landed.
        armed: Whether a mission is on: from the operator's start to its end, LAND or ESTOP.
        reference: What the low-level controller was last told to follow [m/s], shape (3,).
        yaw_rate: Capped [rad/s]; the published low-level controller holds yaw at 0 regardless.
        changes: Of the state, since the last `take_changes`.
        counts: How often a limit changed what was commanded: "limited_speed", "limited_yaw_rate"
            (commands), "limited_fence" (ticks).
    """

    def __init__(self, limits: Limits) -> None:
        """Begin on the ground."""
        self._limits = limits
        self._speed_max = limits.speed_max * rules.JUST_BELOW
        self._low, self._high = limits.inside()
        self._floor, half = self._low[2], 0.5 * limits.speed_max
        self._rest, self._descent = Rest(self._low, self._high, half), Descent(self._floor, half)
        self._hits, self._take_off = Hits(), TakeOff(limits.fence_low, limits.fence_high)
        self.changes: list[GuardChange] = []
        self.counts: Counter[str] = Counter()
        self.state, self.cause = GROUND, Cause.SPAWN
        self.armed = self._flies = False
        self.yaw_rate, self._alone_ns = 0.0, 0
        self.reference = self._wanted = ZERO
        self._track_until_ns = self._steady_until_ns = self._ramp_until_ns = NEVER_NS
        self._tracked_ns = self._held_ns = -SETTLE_NS
        self._fresh_ns: deque[int] = deque(maxlen=RESUME_COMMANDS)
        self._invalid_ns: deque[int] = deque(maxlen=INVALID_COMMANDS)

    @property
    def brakes(self) -> bool:
        """Whether the robot is coming to rest, and has no position to hold yet."""
        return self._rest.brakes

    @property
    def latched(self) -> bool:
        """Whether nothing goes on without the operator's acknowledgement."""
        return self.state is LAND or self.state is ESTOP

    def take_changes(self) -> list[GuardChange]:
        """Hand over the changes of state since the last call."""
        changes, self.changes = self.changes, []
        return changes

    def put_on_ground(self, now_ns: int, cause: str) -> None:
        """The robot stands at its spawn: rotors off, nothing is remembered."""
        self.forget_commands()
        self._tracked_ns = self._held_ns = -SETTLE_NS
        self._enter(GROUND, now_ns, Cause.SPAWN, cause)

    def start_mission(self, now_ns: int) -> None:
        """The operator starts a mission: from here on fresh commands are flown.

        Not while the operator has to acknowledge first why the robot landed or was stopped.
        """
        if self.latched:
            return
        if not self.armed:
            self.forget_commands()  # only what is computed for this mission counts
            self._alone_ns = now_ns
        self.armed = True

    def end_mission(self, now_ns: int) -> None:
        """The mission is over: hold here until the operator starts the next one."""
        self.armed = False
        if self.state is TRACK:
            self._enter(HOLD, now_ns, Cause.ENDED)

    def stop(self, now_ns: int) -> None:
        """Stop the rotors at once, whatever the robot does."""
        if self.state is not ESTOP:
            self._enter(ESTOP, now_ns, Cause.STOPPED)

    def acknowledge(self, now_ns: int) -> None:
        """The operator knows why the robot lands or was stopped; no mission is on."""
        if self.latched and not self._flies:
            self._enter(GROUND, now_ns, self._take_off.condition)
        elif self.state is LAND:
            self._descent.acknowledged = True

    def forget_commands(self) -> None:
        """A new session or mission begins: what came before is no longer fresh."""
        self._track_until_ns = self._steady_until_ns = NEVER_NS
        self._fresh_ns.clear()
        self._invalid_ns.clear()
        self._wanted, self.yaw_rate = ZERO, 0.0

    def offer(self, command: Command, now_ns: int) -> str | None:
        """Take a command that the tunnel lets through.

        Args:
            command: Any numbers at all.
            now_ns: World's clock [ns].

        Returns:
            None if it may be flown, else why it is refused: "range", of NaN, too; "future", if it
            names odometry that has yet to be measured; "stale".
        """
        velocity, yaw_rate = command.velocity, command.yaw_rate
        x, y, z = velocity
        if not (abs(x) <= RANGE and abs(y) <= RANGE and abs(z) <= RANGE and abs(yaw_rate) <= RANGE):
            self._note_invalid(now_ns)
            return "range"
        limits = self._limits
        age_ns = now_ns - command.basis_stamp_ns
        if age_ns < 0:
            self._note_invalid(now_ns)
            return "future"
        if age_ns > limits.command_age_max_ns:
            return "stale"
        if self.armed:
            fresh_until_ns = command.basis_stamp_ns + limits.command_age_max_ns
            self._wanted = rules.shortened(velocity, self._speed_max)
            self.yaw_rate = rules.within(yaw_rate, -limits.yaw_rate_max, limits.yaw_rate_max)
            if self._wanted is not velocity:
                self.counts["limited_speed"] += 1
            if self.yaw_rate != yaw_rate:
                self.counts["limited_yaw_rate"] += 1
            if self.state is GROUND:
                self._alone_ns = now_ns
                if self._settled(now_ns, fresh_until_ns):
                    self._enter(TRACK, now_ns, Cause.COMMAND)
            elif self.state is HOLD:
                self._leave_hold(now_ns, fresh_until_ns)
            if self.state is TRACK:
                self._track_until_ns = fresh_until_ns
        return None

    def _leave_hold(self, now_ns: int, fresh_until_ns: int) -> None:
        """One more fresh command has come: fly again once the link has proven itself."""
        self._fresh_ns.append(now_ns)
        took_ns = now_ns - self._fresh_ns[0]
        enough = len(self._fresh_ns) == RESUME_COMMANDS and took_ns <= RESUME_NS
        if enough and self._settled(now_ns, fresh_until_ns):
            told = f"{RESUME_COMMANDS} fresh commands within {took_ns * 1e-9:.3f} s"
            self._enter(TRACK, now_ns, Cause.COMMANDS, told)
            self._ramp_until_ns = now_ns + self._limits.ramp_ns

    def _settled(self, now_ns: int, fresh_until_ns: int) -> bool:
        """Whether TRACK may be, and it and the next HOLD keep their distance from the last ones."""
        apart_ns = min(fresh_until_ns - self._held_ns, now_ns - self._tracked_ns)
        return self._take_off.allowed and apart_ns >= SETTLE_NS

    def _note_invalid(self, now_ns: int) -> None:
        """An honest cloud never says that: one that goes on saying it is not flown any more."""
        self._invalid_ns.append(now_ns)
        if len(self._invalid_ns) < INVALID_COMMANDS or now_ns - self._invalid_ns[0] > INVALID_NS:
            return
        if self.armed and self.state is not GROUND:
            self._enter(LAND, now_ns, Cause.IMPOSSIBLE, IMPOSSIBLE)

    def tick(self, now_ns: int, readings: Readings, dt: float) -> Vector | None:
        """Say what the low-level controller shall follow now.

        Args:
            now_ns: World's clock [ns].
            readings: Of the sensors on board.
            dt: Time since the last tick [s].

        Returns:
            Velocity reference [m/s], shape (3,); None while the rotors stand still.
        """
        # The usual case: the same command as in the last tick, and far from the fence.
        if now_ns <= self._steady_until_ns and self.reference is self._wanted:
            return self.reference
        if self._flies and (hit := self._hits.felt(now_ns, readings)):
            self._enter(ESTOP, now_ns, hit)
        elif not self._take_off.over:
            self._take_off.look(readings, self._flies)
        if now_ns <= self._track_until_ns:
            change_max = self._limits.acceleration_max * dt
            reference = rules.towards(self.reference, self._wanted, change_max)
        else:
            self._look_after_itself(now_ns, readings)
            if not self._flies:
                return None
            sink = self._descent.speed if self.state is LAND else 0.0
            reference = self._rest.follow(self.reference, readings, sink, dt)
        self._follow(reference, now_ns, readings, dt)
        return self.reference

    def _follow(self, reference: Vector, now_ns: int, readings: Readings, dt: float) -> None:
        """Take a reference as far as the robot stays upright, and inside the fence."""
        climb, position = readings.velocity[2], readings.position
        if reference[2] < climb - rules.SINK_LAG:
            reference = rules.upright(reference, self.reference, climb, self._speed_max)
        if rules.is_far(reference, position, self._low, self._high):
            self._steady_until_ns = min(self._track_until_ns, now_ns + rules.GLIMPSE_NS)
        else:
            self._steady_until_ns = NEVER_NS
            inside = rules.fenced(reference, position, self._low, self._high)
            if inside != reference:
                self.counts["limited_fence"] += 1
                inside = rules.held_back(self.reference, inside, self._limits.acceleration_max * dt)
                reference = rules.shortened(inside, self._speed_max)
        if now_ns < self._ramp_until_ns:
            reference = rules.held_back(self.reference, reference, rules.BRAKE * dt)
        self.reference = reference

    def _look_after_itself(self, now_ns: int, readings: Readings) -> None:
        """Change the state where no fresh command leads."""
        state, limits = self.state, self._limits
        if state is TRACK and self._track_until_ns == NEVER_NS:
            self._enter(HOLD, now_ns, Cause.SESSION)
        elif state is TRACK:
            self._enter(HOLD, now_ns, Cause.SILENCE, limits.too_old(now_ns - self._track_until_ns))
        elif self.armed and now_ns - self._alone_ns > limits.alone_max_ns(self._flies):
            self._enter(LAND, now_ns, Cause.ALONE, limits.left_alone(self._flies))
            self._flies = state is HOLD  # not in GROUND
        elif state is LAND and self._flies:
            if self._descent.may_stop(readings):
                self._enter(HOLD, now_ns, Cause.NOT_DOWN)
            elif self._descent.is_over(now_ns, self.reference, readings):
                state = GROUND if self._descent.acknowledged else LAND
                self._enter(state, now_ns, Cause.DOWN)
                self._flies, self.reference = False, ZERO
                self._take_off.forget(stopped=True)  # on a pipe, perhaps, from which it slides off
        if self.state is HOLD and self._take_off.may_end(readings):
            self._enter(GROUND, now_ns, Cause.NOT_OFF)

    def _enter(self, state: GuardState, now_ns: int, cause: Cause, told: str = "") -> None:
        """Change the state; every change is noted with its cause, in words of its own if `told`."""
        self.cause = self.cause if cause is Cause.DOWN and state is LAND else cause
        if self.state is not HOLD or state is not LAND:  # goes down where it has held
            self._rest.forget()
        self.state, self._flies = state, state is not GROUND and state is not ESTOP
        self._track_until_ns = self._steady_until_ns = self._ramp_until_ns = NEVER_NS
        self._low = (*self._low[:2], -inf if state is LAND else self._floor)
        if state is TRACK:
            self._tracked_ns = now_ns
        elif state is HOLD:
            self._held_ns = self._alone_ns = now_ns
            self._fresh_ns.clear()
        else:
            self.armed = self.armed and cause is Cause.NOT_OFF
            self._descent.begin(now_ns)
            if state is not LAND:
                self.reference = ZERO
                self._hits.forget()
                self._take_off.forget(stopped=state is ESTOP)
        self.changes.append(GuardChange(now_ns, state, told or cause.words))
