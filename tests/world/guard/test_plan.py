# SPDX-License-Identifier: Apache-2.0

"""How the guard flies the plan of a command, and how it trusts nothing of it."""

from math import inf, nan, nextafter

import pytest

from cloudrc.config.resolved import ResolvedGuard
from cloudrc.wire.messages import Cause, GuardState
from cloudrc.world.guard.limits import AGE_MAX_NS, COMMAND_MAX
from tests.world.guard.conftest import MS, TICK, armed, command, run
from tests.world.guard.test_state import told

TRACK, HOLD = GuardState.TRACK, GuardState.HOLD
PLANS = ResolvedGuard(speed_max_mps=4.0, plan_max_s=0.8)


def planned(speeds, basis_ns=0, planned_ns=None):
    """Return a command along x: its velocity and a plan [m/s]."""
    first, *rest = [(speed, 0.0, 0.0) for speed in speeds]
    begin_ns = basis_ns if planned_ns is None else planned_ns
    return command(first, basis_ns)._replace(plan=tuple(rest), planned_ns=begin_ns)


def following(sent, limits=PLANS, now_ns=0):
    guard = armed(limits)
    assert guard.accept_command(sent, now_ns) is None
    return guard


def test_a_plan_is_played_at_its_own_times():
    guard = following(planned([0.0, 0.1, 0.2, 0.3], planned_ns=10 * MS), now_ns=20 * MS)
    flown = [reference[0] for reference in run(guard, 20 * MS, 60 * MS)]
    assert flown[4::5] == [0.1, 0.2, 0.3, 0.3]
    early = following(planned([0.1, 0.2], planned_ns=30 * MS))
    assert [reference[0] for reference in run(early, 0, 60 * MS)][14::5] == [0.1, 0.1, 0.2, 0.2]


def test_the_newest_plan_wins():
    guard = following(planned([0.1] * 60))
    run(guard, 0, 100 * MS)
    guard.accept_command(planned([0.2] * 3, basis_ns=100 * MS), 100 * MS)
    run(guard, 100 * MS, 200 * MS)
    assert guard.reference == (0.2, 0.0, 0.0)
    guard.accept_command(command((0.3, 0.0, 0.0), 200 * MS), 200 * MS)
    run(guard, 200 * MS, 220 * MS)
    assert guard.reference == (0.3, 0.0, 0.0), "a command without a plan ends it"


@pytest.mark.promise("brakes-without-commands")
@pytest.mark.parametrize(
    ("steps", "planned_ms", "arrival_ms", "plan_max_ms", "until_ms"),
    [
        (40, 0, 0, 800, 400),  # while the plan lasts
        (40, 50, 100, 800, 450),
        (80, 100, 100, 800, 900),  # at most 0.8 s from its arrival
        (81, 200, 100, 800, 900),
        (40, 0, 0, 0, 250),  # no plans
        (10, 0, 0, 800, 250),  # the age of the odometry counts as without a plan
        (40, 0, 250, 800, 400),  # the odometry was just fresh
    ],
)
def test_a_plan_is_fresh_while_it_lasts(steps, planned_ms, arrival_ms, plan_max_ms, until_ms):
    limits = ResolvedGuard(speed_max_mps=4.0, plan_max_s=plan_max_ms / 1000)
    plan = planned([0.1] * steps, planned_ns=planned_ms * MS)
    guard = following(plan, limits, arrival_ms * MS)
    run(guard, arrival_ms * MS, until_ms * MS + 1)
    assert guard.state is TRACK
    run(guard, until_ms * MS + TICK, until_ms * MS + 2 * TICK)
    age = f"{(until_ms + 2) / 1000:.3f}"
    text = f"command age {age} s above 0.250 s, and its plan has ended"
    assert told(guard) == (until_ms * MS + TICK, HOLD, text)
    assert guard.cause is Cause.SILENCE
    assert guard.accept_command(plan, until_ms * MS + 2 * TICK) == "stale"


def with_a_bad_value(bad, place, axis):
    velocity = tuple(bad if k == axis else 0.1 for k in range(3))
    plan = [(0.1, 0.0, 0.0)] * 40
    plan[place] = velocity
    return planned([0.1])._replace(plan=tuple(plan))


@pytest.mark.parametrize(
    "absurd",
    [
        *map(with_a_bad_value, (nan, inf, nextafter(COMMAND_MAX, inf), -1000.1), (0, 39, 39, 0),
             (0, 1, 2, 2)),
        *(planned([0.1] * 9, planned_ns=ahead_ns)
          for ahead_ns in (-1, AGE_MAX_NS + 1, -(2**63), 2**63 - 1)),
    ],
)  # fmt: skip
def test_a_plan_with_one_absurd_number_is_rejected_as_a_whole(absurd):
    guard = following(planned([0.1] * 60))
    for _ in range(5):
        assert guard.accept_command(absurd, 0) == "range"
    assert guard.state is GuardState.LAND


def test_a_plan_is_capped_and_forgotten_with_the_session():
    guard = following(planned([0.1, 9.0, 9.0, *[0.2] * 60]))
    run(guard, 0, 50 * MS)
    assert guard.counts["limited_speed"] == 2
    guard.forget_commands()
    assert run(guard, 50 * MS, 60 * MS)[-1] == (0.0, 0.0, 0.0)
    assert guard.state is HOLD


@pytest.mark.parametrize("ends", ["end_mission", "stop", "put_on_ground"])
def test_no_plan_outlives_its_mission(ends):
    guard = following(planned([0.1] * 60))
    run(guard, 0, 50 * MS)
    cause = ("test",) if ends == "put_on_ground" else ()
    getattr(guard, ends)(50 * MS, *cause)
    guard.acknowledge(50 * MS)
    guard.start_mission(50 * MS)
    run(guard, 50 * MS, 500 * MS)
    assert guard.state is (HOLD if ends == "end_mission" else GuardState.GROUND)
    assert guard.reference == (0.0, 0.0, 0.0)


def test_a_plan_does_not_shorten_the_settling_time():
    """Ten commands with plans of 0.8 s end a HOLD no sooner than ten without a plan."""
    guard = following(planned([0.1]))
    run(guard, 0, 260 * MS)
    for now_ns in range(260 * MS, 1000 * MS, 10 * MS):
        guard.accept_command(planned([0.1] * 81, basis_ns=now_ns), now_ns)
    assert guard.state is HOLD
    guard.accept_command(planned([0.1] * 81, basis_ns=1010 * MS), 1010 * MS)
    assert guard.state is TRACK
