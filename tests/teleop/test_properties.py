# SPDX-License-Identifier: Apache-2.0

"""The mission machine under any order of verbs, flights, silences and restarts."""

from contextlib import nullcontext

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from cloudrc.teleop.refusals import ConflictError, UnknownMissionError
from cloudrc.teleop.store import Order
from cloudrc.teleop.wire import Leg, Plan
from cloudrc.wire.messages import Setpoint, Start
from cloudrc.wire.records import MissionEvent
from tests.teleop.conftest import ServiceFlight

UNDER_WAY = {"starting", "flying", "held"}
ENDS = {"idle", "done", "failed", "cancelled"}
ALLOWED = {
    "create": ENDS,
    "go_to": {"held"} | ENDS,
    "hold": {"flying"},
    "resume": {"held"},
    "cancel": UNDER_WAY,
}
FAILURES = {"timed_out", "leg_timed_out", "world_restarted", "guard_stopped"}

coordinates = st.integers(-3, 3).map(float)
positions = st.tuples(coordinates, coordinates, coordinates)
legs = st.builds(
    Leg,
    position=positions,
    tolerance=st.sampled_from([0.1, 1.5]),
    dwell=st.sampled_from([0.0, 0.1]),
    time_limit=st.sampled_from([1.0, 60.0]),
)
plans = st.builds(
    Plan,
    legs=st.lists(legs, min_size=1, max_size=6).map(tuple),
    start=st.sampled_from(Start),
    time_limit=st.sampled_from([2.0, 600.0]),
)
verbs = st.one_of(
    st.tuples(st.just("create"), st.builds(Order, plans)),
    st.tuples(st.just("go_to"), st.builds(Leg, positions)),
    st.sampled_from([("hold",), ("resume",), ("cancel", "m1")]),
)


class MissionMachine(RuleBasedStateMachine):
    """Checks all that teleop has said after everything that can happen to it."""

    def __init__(self):
        super().__init__()
        self.flight = ServiceFlight()
        self.checked = self.reached = 0

    @property
    def state(self):
        return self.flight.newest.state if self.flight.newest else "idle"

    @rule(verb=verbs)
    def operate(self, verb):
        flight, (name, *words) = self.flight, verb
        if name == "cancel" and flight.newest:
            words = [flight.newest.id]
        before, is_allowed = (self.state, len(flight.said)), self.state in ALLOWED[name]
        refused = pytest.raises((ConflictError, UnknownMissionError))
        with nullcontext() if is_allowed else refused:
            getattr(flight.teleop, name)(*words, flight.now_ns)
        flight.collect()
        assert is_allowed or before == (self.state, len(flight.said))
        if name in ("create", "go_to") and self.state == "starting":
            self.reached = 0

    @precondition(lambda self: self.flight.setpoints)
    @rule(times=st.integers(1, 8), seconds=st.sampled_from([0.01, 0.12, 0.3]))
    def fly_to_the_setpoint(self, times, seconds):
        for _ in range(times):
            self.flight.step(self.flight.setpoints[-1].position, seconds)

    @rule(position=positions, seconds=st.sampled_from([0.01, 0.3, 1.5]))
    def fly_elsewhere(self, position, seconds):
        self.flight.step(position, seconds)

    @rule(silent=st.sampled_from(["neither", "neither", "uplink", "downlink"]))
    def change_link(self, silent):
        self.flight.uplink, self.flight.downlink = silent != "uplink", silent != "downlink"

    @rule()
    def restart_world(self):
        self.flight.restart()

    @invariant()
    def all_is_well(self):
        self.check_what_was_said()
        self.check_the_outcome()
        self.check_the_last_setpoint()

    def check_what_was_said(self):
        for said in self.flight.said[self.checked :]:
            if isinstance(said, Setpoint):
                # Waypoints are flown to one after the other, each only when those before are done.
                assert said.waypoint in (-1, self.reached)
            elif isinstance(said, MissionEvent) and said.event == "reached":
                assert said.waypoint == self.reached
                self.reached += 1
        self.checked = len(self.flight.said)

    def check_the_outcome(self):
        last = self.flight.events[-1].event if self.flight.events else "idle"
        if self.state in UNDER_WAY | {"idle"}:
            assert last not in {"done", "cancelled"} | FAILURES or self.state == "starting"
            return
        legs = self.flight.newest.order.plan.legs
        assert (self.state == "done") == (self.reached == len(legs))
        assert last in (FAILURES if self.state == "failed" else {self.state})

    def check_the_last_setpoint(self):
        if self.flight.setpoints:
            aims = {"flying": {self.reached}, "starting": {-1, self.reached}}
            assert self.flight.setpoints[-1].waypoint in aims.get(self.state, {-1})


MissionMachine.TestCase.settings = settings(max_examples=25, stateful_step_count=40, deadline=None)
TestMissionMachine = MissionMachine.TestCase
