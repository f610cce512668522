"""The invariants, looked at in every step of the physics, by nobody who could be wrong with them.

No fence breach: the base stays inside the fence as long as its rotors turn; where the operator's
word or a hit has stopped them, it may fall out of it, which is told, but not as far as people have
to stay away, and they turn again only where the robot lies still, inside the fence. What is flown
stays below the caps and can be stopped in time, before the floor, too, unless the robot lands. No
motion on stale commands: in TRACK the newest accepted command's basis is never older than its
limit, and where TRACK ends the robot stops, within the way that this takes; its rotors turn until
it stands. What has landed or was stopped stays so until the operator acknowledges it; only what was
started is in TRACK; how a HOLD ends is told in `hold_end`. No collision, under an honest cloud:
nothing but the arm's tip touches anything, and that the board, and no hit is felt without a touch.
A robot that lands, since its cloud is gone for good or says what no honest one does, sinks where it
is, and one that the operator stops falls: the guard knows the fence, and not what lies below. What
it comes down on is told, and no collision, also where the operator has acknowledged a landing too
late for it to stop above that.

The invariant of how rotors stop: by a word, by a hit, or where the robot stands.

A guard that lets its rotors stop in the air drops the robot. Told by what the simulator is given,
not by speeds of 0, which hard braking commands, too.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from math import hypot, inf, sqrt
from typing import Any, NamedTuple

from cloudrc.faults import hold_end
from cloudrc.faults import hold_end as ticks
from cloudrc.faults import hold_end as word
from cloudrc.faults.hold_end import TICK_NS, Patience, growth
from cloudrc.geometry.fence import HIGH, LOW, inside
from cloudrc.messages import ZERO, Command, GuardState, Vector
from cloudrc.records import Contact
from cloudrc.world.rotors import STOPPED

ESTOP = GuardState.ESTOP
STANDS = 0.2
"""What stands has no component of its velocity above this [m/s]."""
FALL = 1.0
"""Faster down than what drops from no higher than the guard's 0.02 m [m/s]: that gets to 0.7."""
REELS_NS = 1_000_000_000
"""For so long a hit explains what has become of the robot [ns]."""


def attach_halts(
    robot: Any, start_ns: int, note: Callable[[int, str, str], None], *, honest: bool
) -> None:
    """Look at every step of a robot that begins now.

    Args:
        robot: Its guard and its simulator are looked at.
        start_ns: Instant of the first step [ns].
        note: Is told of a breach: instant [ns], kind, what happened.
        honest: Whether a hit that was none is a breach.
    """
    simulator, guard = robot.simulator, robot.guard
    step, stop, put_on_ground = simulator.step, guard.stop, guard.put_on_ground
    now_ns, was, turned, asked = start_ns, guard.state, False, False
    halted, stopped, standing, falling = False, ESTOP, STOPPED, -FALL

    def watched_stop(when_ns: int) -> None:
        nonlocal asked
        asked = True
        stop(when_ns)

    def watched_put_on_ground(when_ns: int, cause: str) -> None:
        nonlocal asked
        asked = True
        put_on_ground(when_ns, cause)

    def watched_step(rotor_speeds: Any) -> None:
        nonlocal now_ns, was, turned, asked, halted
        state, turns = guard.state, rotor_speeds is not standing
        if state is not was:
            if state is stopped and honest and not asked and not has_touched(simulator):
                note(now_ns, "collision", "stopped by a hit although nothing was touched")
            was = state
        if turned and not turns:
            halted = not asked and state is not stopped
            if halted:
                _look_at_halt(simulator.readings.velocity, state, now_ns, note)
        elif halted:
            halted = not turns and not asked
            if halted and simulator.readings.velocity[2] < falling and not has_touched(simulator):
                note(now_ns, "rest", f"falls in {state.name}, its rotors stopped in the air")
                halted = False
        turned, asked = turns, False
        step(rotor_speeds)
        now_ns += TICK_NS

    simulator.step, guard.stop = watched_step, watched_stop
    guard.put_on_ground = watched_put_on_ground


def has_touched(simulator: Any) -> bool:
    """Say whether the robot touches something, or has just touched it."""
    last = max(simulator._last_touch.values(), default=-inf)
    return bool((simulator._steps - last) * TICK_NS <= REELS_NS)


def _look_at_halt(
    velocity: Vector, state: GuardState, now_ns: int, note: Callable[[int, str, str], None]
) -> None:
    fastest = max(map(abs, velocity))
    if not fastest <= STANDS:
        note(now_ns, "rest", f"rotors stopped in {state.name} at {fastest:.2f} m/s")


SLACK = 1e-9
"""For rounding [m/s]."""
FLOWN = (GuardState.TRACK, GuardState.HOLD, GuardState.LAND)
ABOVE_GROUND = (GuardState.TRACK, GuardState.HOLD)
REPORTED = 5
"""Of each kind."""
STILL = 0.12
"""Slower than this a robot lies [m/s]: the guard's 0.1, and what a fall adds in a tick."""
REST = 0.5
"""So much farther than its way to a stop a robot that is left alone may go [m]: it swings back. In
200 flights of the search, half of them under a hostile cloud, it was 0.20 at most."""
FALL_MAX = 1.5
"""How far outside the fence people are told to stay [m]. Source: docs/safety.md, "The guard"."""


class Breach(NamedTuple):
    """An invariant that did not hold.

    Attributes:
        time: World's clock [s].
        kind: "collision", "fence", "cap", "stop", "stale", "rest", "latch", "hold", "tick",
            "obeyed", "order", "waypoint", "stuck", "alarm", "recording" or "error".
        text: What happened.
    """

    time: float
    kind: str
    text: str


class Watch:
    """Watches one world.

    Attributes:
        breaches: The first ones of each kind.
        counts: Of all of them, by kind.
        margin: Smallest distance of the base to a face of the fence other than the floor [m].
        speed: Largest speed flown [m/s].
        fallen: How far outside the fence the base came with its rotors stopped by the operator's
            word [m]; 0 if it did not.
        thrown: Likewise, its rotors stopped by a hit [m].
        landed_on: What was touched by a robot that landed, or was stopped by the operator's word,
            the floor left out, and until it flew again.
    """

    def __init__(
        self,
        speed_max: float,
        acceleration_max: float,
        yaw_rate_max: float,
        age_max_ns: int,
        hold_max_ns: int = 60_000_000_000,
    ) -> None:
        """Learn the limits, from the configuration and not from the guard.

        Args:
            speed_max: Cap on the reference [m/s].
            acceleration_max: Cap on its change [m/s^2].
            yaw_rate_max: Cap on the yaw rate [rad/s].
            age_max_ns: Of a command's basis [ns].
            hold_max_ns: HOLD in a mission ends in LAND after it [ns].
        """
        self._patience = Patience(speed_max, hold_max_ns)
        self._speed_max = speed_max + SLACK
        self._step_max = acceleration_max * TICK_NS * 1e-9 + SLACK
        self._age_max_ns, self._yaw_rate_max = age_max_ns, yaw_rate_max
        self.breaches: list[Breach] = []
        self.counts: Counter[str] = Counter()
        self.margin, self.speed = 9.0, 0.0
        self.fallen = self.thrown = 0.0
        self.landed_on: set[str] = set()
        self._hit: tuple[int, str] | None = None
        self._comes_down = False
        self._left: Vector = ZERO
        self._way = inf

    def attach(self, world: Any, start_ns: int, *, honest: bool = False) -> None:
        """Look at every step of a world that begins now, and at every command that it accepts.

        Args:
            world: Which.
            start_ns: Instant of the first step [ns].
            honest: Whether its cloud is, so that a hit is its failure or the guard's.
        """
        robot = world.robot
        self._attach_to_flight(robot.simulator, robot.guard, start_ns)
        self._attach_to_states(robot.simulator, robot.guard, start_ns)
        ticks.attach_ticks(robot, start_ns, self.note)
        operator = word.attach_word(robot, start_ns, self.note)
        hold_end.attach_hold_end(robot, start_ns, self.note, operator, self._patience)
        attach_halts(robot, start_ns, self.note, honest=honest)

    def _attach_to_flight(self, simulator: Any, guard: Any, start_ns: int) -> None:
        """Look at where it is, and at what it flies by."""
        step, offer, stop = simulator.step, guard.offer, guard.stop
        now_ns, basis_ns, before = start_ns, -1, ZERO
        flew = falls = hit = False
        age_max_ns, flown = self._age_max_ns, FLOWN
        tracking, landing, stopped = GuardState.TRACK, GuardState.LAND, GuardState.ESTOP

        def watched_offer(command: Command, when_ns: int) -> Any:
            nonlocal basis_ns
            refusal = offer(command, when_ns)
            if not refusal and command.basis_stamp_ns > basis_ns:
                basis_ns = command.basis_stamp_ns
            return refusal

        def watched_stop(when_ns: int) -> None:
            nonlocal falls
            falls = falls or guard.state in flown
            self._comes_down = self._comes_down or falls
            stop(when_ns)

        def watched_step(rotor_speeds: Any) -> None:
            nonlocal now_ns, before, flew, falls, hit
            state, reference = guard.state, guard.reference
            position = simulator.readings.position
            flies = state in flown
            hit = hit or (flew and state is stopped and not falls)
            if flies and (falls or hit):
                falls = hit = False
                self._look_at_take_off(position, simulator.readings.velocity, now_ns)
            self._look_at_fence(position, falls, hit, now_ns)
            flew = flies
            if flies:
                self._comes_down = state is landing
                self._look_at_stop(position, reference, state is landing, now_ns)
                self._look_at_turning(guard.yaw_rate, now_ns)
                if reference is not before:
                    self._look_at_caps(before, reference, state is tracking, now_ns)
                if state is tracking and now_ns - basis_ns > age_max_ns:
                    age = (now_ns - basis_ns) * 1e-9
                    self.note(now_ns, "stale", f"TRACK on a command {age:.3f} s old")
            before = reference
            step(rotor_speeds)
            now_ns += TICK_NS

        simulator.step, guard.offer, guard.stop = watched_step, watched_offer, watched_stop

    def _attach_to_states(self, simulator: Any, guard: Any, start_ns: int) -> None:
        """Look at what the guard's states promise: rotors that stand, a robot that stops."""
        step, now_ns, was, before = simulator.step, start_ns, guard.state, ZERO
        tracking, flown = GuardState.TRACK, FLOWN

        def watched_step(rotor_speeds: Any) -> None:
            nonlocal now_ns, was, before
            state = guard.state
            if state is not was:
                if was is tracking:
                    self._leave_alone(simulator.readings, before, now_ns)
                was = state
            if state not in flown:
                if any(rotor_speeds):
                    self.note(now_ns, "latch", f"rotors turn in {state.name}")
            elif state is not tracking and any(rotor_speeds):
                self._look_at_rest(simulator.readings.position, now_ns)
            before = guard.reference
            step(rotor_speeds)
            now_ns += TICK_NS

        simulator.step = watched_step

    def _leave_alone(self, readings: Any, reference: Vector, now_ns: int) -> None:
        """From here on no command is flown: the robot goes on for as far as it takes to stop."""
        speed = max(hypot(*readings.velocity), hypot(*reference))
        self._left, self._way = readings.position, speed * (0.2 + speed / 6.0) + REST
        if self._hit is not None and now_ns - self._hit[0] < REELS_NS:
            self._way = inf

    def _look_at_rest(self, position: Vector, now_ns: int) -> None:
        """In HOLD and LAND the robot stops, and stays above where it has; a hit excuses it."""
        dx, dy = position[0] - self._left[0], position[1] - self._left[1]
        if dx * dx + dy * dy > self._way * self._way:
            self.note(now_ns, "rest", f"{hypot(dx, dy):.2f} m from where the last command ended")

    def _look_at_take_off(self, position: Vector, velocity: Vector, now_ns: int) -> None:
        """After a stop the rotors turn again only where the robot lies still inside the fence."""
        if hypot(*velocity) > STILL or not inside(position):
            x, y, z = position
            text = f"base at ({x:.2f}, {y:.2f}, {z:.2f}) at {hypot(*velocity):.2f} m/s"
            self.note(now_ns, "fence", f"took off after a stop, {text}")

    def _look_at_fence(self, position: Vector, falls: bool, hit: bool, now_ns: int) -> None:
        x, y, z = position
        (xl, yl, zl), (xh, yh, zh) = LOW, HIGH
        margin = min(x - xl, xh - x, y - yl, yh - y, zh - z)
        if z < zl:
            self.note(now_ns, "fence", f"base at ({x:.2f}, {y:.2f}, {z:.2f}), below the floor")
        if falls or hit:
            if falls:
                self.fallen = max(self.fallen, -margin)
            else:
                self.thrown = max(self.thrown, -margin)
            if margin < -FALL_MAX:
                self.note(now_ns, "fence", f"base fell to ({x:.2f}, {y:.2f}, {z:.2f})")
        elif margin < self.margin:
            self.margin = margin
            if margin < 0.0:
                text = f"base at ({x:.2f}, {y:.2f}, {z:.2f})"
                if self._hit is not None:
                    hit_ns, body = self._hit
                    text += f", {(now_ns - hit_ns) * 1e-9:.2f} s after it hit {body}"
                self.note(now_ns, "fence", text)

    def _look_at_stop(self, position: Vector, reference: Vector, lands: bool, now_ns: int) -> None:
        (x, y, z), (vx, vy, vz) = position, reference
        (xl, yl, zl), (xh, yh, zh) = LOW, HIGH
        if not (
            stops(vx, x - xl, xh - x)
            and stops(vy, y - yl, yh - y)
            and (stops(vz, z - zl, zh - z) or (lands and vz < 0.0))
        ):
            text = f"({vx:.3f}, {vy:.3f}, {vz:.3f}) m/s at ({x:.2f}, {y:.2f}, {z:.2f})"
            self.note(now_ns, "stop", f"reference {text}")

    def _look_at_caps(self, before: Vector, reference: Vector, ramped: bool, now_ns: int) -> None:
        vx, vy, vz = reference
        speed = sqrt(vx * vx + vy * vy + vz * vz)
        if speed > self.speed:
            self.speed = speed
        if not speed <= self._speed_max:  # NaN is no speed either
            self.note(now_ns, "cap", f"reference {speed:.3f} m/s")
        # Slowing down may be as hard as it must: at the fence, or when something was hit.
        grown = growth(before, reference)
        if ramped and not grown <= self._step_max:
            self.note(now_ns, "cap", f"reference grows by {grown:.9f} m/s in a tick")

    def _look_at_turning(self, yaw_rate: float, now_ns: int) -> None:
        if not abs(yaw_rate) <= self._yaw_rate_max:  # NaN is no rate either
            self.note(now_ns, "cap", f"reference turns by {yaw_rate:.3f} rad/s")

    def see(self, contact: Contact, guard: GuardState, honest: bool) -> None:
        """Judge a contact; under a cloud that is not honest it only explains what comes later."""
        body = contact.body
        self._hit, self._way = (contact.stamp_ns, body), inf
        if not honest:
            return
        low = guard not in ABOVE_GROUND
        if (body == "board" and contact.tip) or (low and body == "floor"):
            return
        if low and (self._comes_down or guard is GuardState.LAND):
            self.landed_on.add(body)
        else:
            part = "tip" if contact.tip else "body"
            self.note(contact.stamp_ns, "collision", f"{part} touched {body} in {guard.name}")

    def note(self, now_ns: int, kind: str, text: str) -> None:
        """Note a breach of some kind at an instant [ns]."""
        self.counts[kind] += 1
        if self.counts[kind] <= REPORTED:
            self.breaches.append(Breach(now_ns * 1e-9, kind, text))


def stops(speed: float, below: float, above: float) -> bool:
    """Say whether the robot can stop before the face that it flies towards.

    Source: docs/reference/plant.md, "Stop rule": 0.2 v + v^2/6 <= distance - 0.1.

    Args:
        speed: Component of the velocity along an axis [m/s].
        below: Distance to the face at the axis' lower end [m].
        above: Distance to the one at its upper end [m].
    """
    if speed > 0.0:
        return speed * (0.2 + speed / 6.0) <= above - 0.1 + SLACK
    return speed == 0.0 or speed * (speed / 6.0 - 0.2) <= below - 0.1 + SLACK
