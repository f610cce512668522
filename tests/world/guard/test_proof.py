# SPDX-License-Identifier: Apache-2.0

"""Proofs of the guard's arithmetic for all 64-bit floats, NaN and infinity included."""

import pytest

from cloudrc.wire.messages import Command
from cloudrc.world.guard import hold
from cloudrc.world.guard import limits as rules
from cloudrc.world.guard.limits import COMMAND_MAX
from cloudrc.world.guard.state import Guard
from tests.conftest import nightly
from tests.fences import FENCE
from tests.world.guard.conftest import LIMITS
from tests.world.guard.proof import everywhere, root, z3


@pytest.fixture(autouse=True)
def abstract_root(monkeypatch):
    monkeypatch.setattr(rules, "sqrt", root)


def is_finite(term):
    return z3.Not(z3.Or(z3.fpIsNaN(term), z3.fpIsInf(term)))


def test_a_command_with_one_value_out_of_range_is_rejected():
    """Prove that `Guard.accept_command` rejects every value beyond COMMAND_MAX, NaN included."""

    def check(run):
        numbers = [run.fresh(name) for name in ("vx", "vy", "vz", "yaw_rate")]
        inside = z3.And([z3.fpAbs(number.term) <= COMMAND_MAX for number in numbers])
        refused = Guard(LIMITS, FENCE).accept_command(
            Command(0, 0, 0, tuple(numbers[:3]), numbers[3]), 0
        )
        assert refused in (None, "range")
        run.prove(z3.Not(inside) if refused else inside)

    # Five paths: all values are in range, or the first bad one is one of the four.
    assert everywhere(check) == 5


def test_clamp_moves_only_values_outside_into_the_interval():
    def check(run):
        value, low, high = (run.fresh(name) for name in ("value", "low", "high"))
        run.learn(z3.And(is_finite(low.term), is_finite(high.term), low.term <= high.term))
        answer = rules.clamp(value, low, high).term
        run.prove(z3.And(answer >= low.term, answer <= high.term))
        inside = z3.And(value.term > low.term, value.term < high.term)
        run.prove(z3.Implies(inside, z3.fpEQ(answer, value.term)))

    assert everywhere(check) == 3


@pytest.mark.parametrize("caution", [rules.FENCE_REACTION, rules.REACTION])
@pytest.mark.parametrize("braking", [3.0, *nightly(0.1, 2.0, 10.0)])
def test_approach_speed_is_a_number_and_has_its_lower_bound(braking, caution):
    def check(run):
        reach = run.fresh("reach")
        speed = rules.approach_speed(reach, rules.stop_coefficient(braking), caution)
        term = lift(run, speed).term
        run.prove(term >= -rules.RETURN_SPEED_MAX)
        # At the face or outside never outwards; inside never back.
        run.prove(z3.Implies(reach.term <= 0.0, term <= 0.0))
        run.prove(z3.Implies(reach.term > 0.0, term >= 0.0))

    assert everywhere(check) >= 4


@pytest.mark.parametrize("at_the_floor", [False, True])
def test_one_axis_of_limit_to_fence_is_finite_and_bounded(at_the_floor):
    """Prove it for any finite command, with the proven bounds of `approach_speed`."""

    def check(run):
        v, up, down = (run.fresh(name) for name in ("v", "up", "down"))
        run.learn(is_finite(v.term))
        run.learn(z3.And(up.term >= -rules.RETURN_SPEED_MAX, down.term >= -rules.RETURN_SPEED_MAX))
        low = min(0.0, -down) if at_the_floor else -down
        term = lift(run, rules.clamp(v, low, up)).term
        bound = z3.fpMax(z3.fpAbs(v.term), z3.FPVal(rules.RETURN_SPEED_MAX, z3.Float64()))
        run.prove(z3.And(is_finite(term), z3.fpAbs(term) <= bound))

    assert everywhere(check) == (6 if at_the_floor else 3)


def test_growth_is_at_most_the_value_itself():
    """Then a limited reference keeps its sign and is never faster than the wanted one."""

    def check(run):
        before, after = run.fresh("before"), run.fresh("after")
        run.learn(z3.And(is_finite(before.term), is_finite(after.term)))
        grown = lift(run, rules.growth(before, after)).term
        run.prove(z3.And(grown >= 0.0, grown <= z3.fpAbs(after.term)))

    assert everywhere(check) >= 6


def test_brake_rate_of_any_speed_is_in_its_range():
    def check(run):
        rate = lift(run, hold.brake_rate(run.fresh("speed"), 3.0)).term
        run.prove(z3.And(rate >= hold.BRAKE_MIN, rate <= hold.BRAKE_MAX))

    everywhere(check)


def lift(run, value):
    if isinstance(value, float | int):
        symbol = run.fresh("constant")
        run.learn(z3.fpEQ(symbol.term, z3.FPVal(value, z3.Float64())))
        return symbol
    return value
