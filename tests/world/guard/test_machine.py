# SPDX-License-Identifier: Apache-2.0

"""The guard keeps its promises after every event, in any order of events."""

from math import hypot, nan

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from cloudrc.config.resolved import ResolvedGuard
from cloudrc.wire.messages import GuardState
from cloudrc.world.guard.state import Guard
from tests.fences import FENCE
from tests.world.guard.conftest import DT, LIMITS, MS, TICK, command, sensed

GROUND, TRACK, HOLD, LAND, ESTOP = GuardState
AGE_MAX_NS = 250 * MS
SECONDS = st.sampled_from([0.002, 0.01, 0.1, 0.3, 1.2, 6.0])
VELOCITIES = st.tuples(*[st.sampled_from([-1e3, -2.0, 0.0, 0.5, 9.0])] * 3)

# Allowed changes of the state (from, to) for each event.
ALLOWED = {
    "start": set(),
    "end": {(TRACK, HOLD), (HOLD, HOLD)},  # a HOLD without a mission has a cause of its own
    "stop": {(state, ESTOP) for state in (GROUND, TRACK, HOLD, LAND)},
    "acknowledge": {(LAND, GROUND), (ESTOP, GROUND)},
    "spawn": {(state, GROUND) for state in GuardState},
    "fresh": {(GROUND, TRACK), (HOLD, TRACK)},
    "stale": set(),
    "impossible": {(TRACK, LAND), (HOLD, LAND)},
    "session": set(),
    "turn_over": {(state, ESTOP) for state in (TRACK, HOLD, LAND)},
    "time": {
        *((TRACK, HOLD), (GROUND, LAND)),
        *((HOLD, state) for state in (GROUND, LAND)),
        *((LAND, state) for state in (LAND, HOLD, GROUND)),
    },
}


class GuardMachine(RuleBasedStateMachine):
    @initialize()
    def begin(self):
        self.guard = Guard(ResolvedGuard(hold_max_s=5.0), FENCE)
        self.now_ns = 0
        self.height = 1.0
        self.climb = 0.0
        self.flown = None
        self.started = False  # whether a mission is active
        self.acknowledged = False  # whether the operator acknowledged the landing
        self.newest_basis_ns = None
        self.stamps = []
        self.state = GROUND

    def noted(self, event):
        """Check that this event allows each change, and that each change has a cause."""
        for change in self.guard.take_changes():
            assert (self.state, change.state) in ALLOWED[event], event
            assert change.cause
            if self.state is LAND and change.state in (HOLD, GROUND):
                assert self.acknowledged
            self.acknowledged &= change.state is self.state is LAND
            assert change.stamp_ns == self.now_ns
            if change.cause == "new session":
                self.stamps.clear()
            elif change.state in (TRACK, HOLD) and event in ("fresh", "time"):
                self.stamps.append(change.stamp_ns)
            elif event == "spawn" or (self.state, change.state) != (HOLD, GROUND):
                self.stamps.clear()  # an operator who starts anew is no chatter
            self.state = change.state
        assert self.state is self.guard.state

    @rule()
    def start(self):
        self.guard.start_mission(self.now_ns)
        started = self.state not in (LAND, ESTOP)
        assert self.guard.armed == started
        if started and not self.started:
            self.newest_basis_ns = None
        self.started |= started
        self.noted("start")

    @rule()
    def end(self):
        self.guard.end_mission(self.now_ns)
        self.started = False
        self.noted("end")

    @rule()
    def stop(self):
        self.guard.stop(self.now_ns)
        self.started = False
        self.noted("stop")
        assert self.state is ESTOP

    @rule()
    def acknowledge(self):
        self.acknowledged = self.state is LAND
        self.guard.acknowledge(self.now_ns)
        self.noted("acknowledge")

    @precondition(lambda self: self.state not in (LAND, ESTOP))
    @rule()
    def spawn(self):
        self.guard.put_on_ground(self.now_ns, "spawn")
        self.started = False
        self.noted("spawn")

    @rule()
    def session(self):
        self.guard.forget_commands()
        self.newest_basis_ns = None
        self.noted("session")

    @rule(velocity=VELOCITIES, count=st.sampled_from([1, 9, 10, 30]), age_ms=st.integers(0, 250))
    def fresh(self, velocity, count, age_ms):
        for _ in range(count):
            assert (
                self.guard.accept_command(command(velocity, self.now_ns - age_ms * MS), self.now_ns)
                is None
            )
            if self.started:
                self.newest_basis_ns = self.now_ns - age_ms * MS
            self.noted("fresh")
            self.pass_time(0.01)

    @rule(count=st.sampled_from([1, 20]), age_ms=st.integers(251, 100_000))
    def stale(self, count, age_ms):
        for _ in range(count):
            stale = command(basis_ns=self.now_ns - age_ms * MS)
            assert self.guard.accept_command(stale, self.now_ns) == "stale"
        self.noted("stale")

    @rule(bad=st.sampled_from([command((nan, 0.0, 0.0)), command(basis_ns=1 << 62)]))
    def impossible(self, bad):
        self.guard.accept_command(bad, self.now_ns)
        self.noted("impossible")
        self.started &= self.state is not LAND

    @rule(seconds=SECONDS)
    def wait(self, seconds):
        self.pass_time(seconds)

    @rule()
    def turn_over(self):
        calm = sensed((1.0, 1.0, self.height), (0.0, 0.0, self.climb))
        flew = self.guard.step(self.now_ns, calm, DT) is not None
        self.noted("time")
        self.now_ns += TICK
        over = calm._replace(axes=(*calm.axes[:8], -1.0))
        self.flown = self.guard.step(self.now_ns, over, DT)
        self.noted("turn_over")
        assert self.flown is None
        assert (self.state is ESTOP) >= flew
        self.started &= not flew
        self.now_ns += TICK

    @rule(height=st.sampled_from([0.1, 0.5, 2.4]))
    def move(self, height):
        self.height = height

    def pass_time(self, seconds):
        for _ in range(round(seconds / DT)):
            standing = self.height < 0.2 or self.flown is None
            sinking = 0.0 if standing else self.flown[2]
            self.climb += min(max(sinking - self.climb, -0.4), 0.4)
            readings = sensed((1.0, 1.0, self.height), (0.0, 0.0, self.climb))
            self.flown = self.guard.step(self.now_ns, readings, DT)
            self.noted("time")
            self.started &= self.state is not LAND
            self.now_ns += 2 * MS

    @invariant()
    def only_a_started_mission_is_flown(self):
        assert self.guard.armed == self.started
        assert self.guard.state is not TRACK or self.started

    @invariant()
    def nothing_stale_is_flown(self):
        if self.flown is not None and self.state is TRACK and self.newest_basis_ns is not None:
            assert self.now_ns - 2 * MS - self.newest_basis_ns <= AGE_MAX_NS + 10 * MS

    @invariant()
    def what_is_flown_is_inside_the_caps(self):
        assert self.flown is None or hypot(*self.flown) <= LIMITS.speed_max_mps
        assert hypot(*self.guard.reference) <= LIMITS.speed_max_mps

    @invariant()
    def it_does_not_chatter(self):
        assert all(c - a >= 1000 * MS for a, c in zip(self.stamps, self.stamps[2:], strict=False))

    @invariant()
    def stopped_rotors_stay_stopped(self):
        if self.state in (GROUND, ESTOP):
            assert self.guard.reference == (0.0, 0.0, 0.0)


TestGuardMachine = GuardMachine.TestCase
TestGuardMachine.settings = settings(max_examples=100, stateful_step_count=25, deadline=None)
