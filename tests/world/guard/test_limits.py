"""No limit of the guard can be switched off, neither in the file nor in code."""

from dataclasses import FrozenInstanceError, fields
from math import inf, nan

import pytest

from cloudrc.config.load import load_experiment
from cloudrc.errors import BadInputError
from cloudrc.geometry.fence import FLOOR_MARGIN
from cloudrc.messages import GuardState
from cloudrc.world.guard.limits import FENCE_MARGIN, Limits
from tests.world.guard.conftest import LIMITS, MS, SECOND, TICK, armed, command, run, tracking

NUMBERS = [field.name for field in fields(Limits) if not field.name.startswith("fence")]


def limits(**values):
    return Limits(LIMITS.fence_low, LIMITS.fence_high, **values)


@pytest.mark.promise("commands-within-caps")
@pytest.mark.parametrize("name", NUMBERS)
def test_a_limit_cannot_be_switched_off_or_changed(name):
    for value in (0, -1, inf, nan):
        with pytest.raises(ValueError, match=f"guard: {name} is"):
            limits(**{name: value})
    with pytest.raises(FrozenInstanceError):
        setattr(LIMITS, name, getattr(LIMITS, name))


def test_a_command_may_not_be_older_than_ten_seconds():
    limits(command_age_max_ns=10 * SECOND, speed_max=0.5)
    with pytest.raises(ValueError, match="above 10 s"):
        limits(command_age_max_ns=10 * SECOND + 1, speed_max=0.5)


@pytest.mark.parametrize(("age_ms", "fastest"), [(250, 6.0), (400, 5.645805), (800, 4.823043)])
def test_a_speed_beyond_the_stop_rule_is_refused(age_ms, fastest):
    # v (T + 0.2) + v^2 / 6 = 8.7 m, solved by hand.
    limits(command_age_max_ns=age_ms * 1_000_000, speed_max=fastest)
    with pytest.raises(ValueError, match="speed_max"):
        limits(command_age_max_ns=age_ms * 1_000_000, speed_max=fastest + 1e-3)


@pytest.mark.parametrize(("hold_s", "waited_s"), [(0.1, 10), (11, 11)])
def test_on_the_ground_it_waits_for_a_mission_for_10_s_at_least(hold_s, waited_s):
    """The longest hold may be too short for a first command to arrive."""
    guard = armed(limits(hold_max_ns=round(hold_s * SECOND)))
    guard.accept_command(command(basis_ns=-300 * MS), SECOND)  # a stale command does not count
    run(guard, 0, waited_s * SECOND + TICK)
    assert guard.state is GuardState.GROUND
    assert run(guard, waited_s * SECOND + TICK, waited_s * SECOND + 2 * TICK) == [None]
    assert (guard.state, guard.armed) == (GuardState.LAND, False)
    assert guard.take_changes()[-1].cause == f"held for {waited_s} s without the cloud"
    guard.acknowledge(62 * SECOND)
    assert guard.state is GuardState.GROUND, "without a touch-down"


def test_in_flight_a_hold_lasts_no_longer_than_its_limit():
    guard = tracking(limits=limits(hold_max_ns=2 * SECOND))
    run(guard, 0, 3 * SECOND)
    land = (2254 * MS, GuardState.LAND, "held for 2 s without the cloud")
    assert land in guard.take_changes()


THIN = FLOOR_MARGIN + FENCE_MARGIN


@pytest.mark.parametrize("axis", range(3))
def test_a_fence_has_room_between_its_margins(axis):
    corner = [9.0] * 3
    corner[axis] = THIN + 0.01
    Limits((0.0, 0.0, 0.0), tuple(corner))
    for high in (-inf, inf, nan, 0.0, THIN):
        corner[axis] = high
        with pytest.raises(ValueError, match="leaves no room"):
            Limits((0.0, 0.0, 0.0), tuple(corner))


def test_the_inner_corners_have_the_margins_taken_off():
    low, high = Limits((0.0, 10.0, 20.0), (5.0, 15.0, 25.0)).inner_corners()
    assert low == pytest.approx((0.2, 10.2, 20.35))
    assert high == pytest.approx((4.8, 14.8, 24.8))


@pytest.mark.parametrize(
    ("key", "values"),
    [
        ("command_age_max_ms", ("10001",)),
        ("speed_max_mps", ("6.5",)),
        ("acceleration_max_mps2", ()),
        ("yaw_rate_max_radps", ()),
        ("hold_max_s", ()),
    ],
)
def test_the_file_refuses_it_too_and_names_the_key(key, values):
    for value in ("0", "-1", ".inf", ".nan", *values):
        with pytest.raises(BadInputError, match=rf"guard\.{key}"):
            load_experiment("paper", [f"guard.{key}={value}"])
