"""The speed near a wall lets a robot that is hit fall inside the fence."""

from math import hypot, inf, nan, sqrt

import pytest

from cloudrc.world.guard import limits as rules
from tests.world.guard.conftest import LIMITS
from tests.world.guard.test_arithmetic import HIGH, LOW


def by_the_wall(axis, sign, distance, height):
    """Return a position at a `distance` [m] from one wall, in the middle of the other axis."""
    position = [3.1, -1.5, height]
    position[axis] = (LIMITS.fence_high if sign > 0 else LIMITS.fence_low)[axis] - sign * distance
    return tuple(position)


def along(axis, speed):
    """Return a velocity [m/s] along the wall that is perpendicular to an axis."""
    velocity = [0.0, 0.0, 0.0]
    velocity[1 - axis] = speed
    return tuple(velocity)


def aside(height):
    """Return the share of the speed that a hit at this height [m] may turn towards a wall."""
    return 0.44 + 0.6 * min(max(height - 0.9, 0.0), 1.0)


WALLS = [(axis, sign) for axis in (0, 1) for sign in (-1, 1)]


@pytest.mark.parametrize("height", [0.5, 1.3, 2.2])
@pytest.mark.parametrize(("axis", "sign"), WALLS)
def test_along_a_wall_a_deflected_robot_stays_before_it(axis, sign, height):
    """It falls from its height with a share of its speed, slides and tumbles."""
    for distance in (0.4, 0.8, 1.2, 1.6):
        place = by_the_wall(axis, sign, distance, height)
        speed = hypot(*rules.limit_to_fence(along(axis, 6.0), place, LOW, HIGH))
        lies = aside(height) * speed * (sqrt(2 * height / 9.81) + 0.4) + 0.3
        assert lies == pytest.approx(distance) or (speed == 0.5 and lies > distance)


@pytest.mark.parametrize("height", [0.5, 1.3, 2.2])
@pytest.mark.parametrize(("axis", "sign"), WALLS)
def test_towards_a_wall_a_falling_robot_stays_before_it(axis, sign, height):
    for distance in (0.4, 0.8, 1.6, 2.4):
        velocity = [0.0, 0.0, 0.0]
        velocity[axis] = 6.0 * sign
        place = by_the_wall(axis, sign, distance, height)
        speed = hypot(*rules.limit_to_fence(tuple(velocity), place, LOW, HIGH))
        stops = 0.6 * speed + speed * speed / 6 + 0.2
        lies = speed * (sqrt(2 * height / 9.81) + 0.4 + 0.2 + 0.3) + 0.3
        assert max(stops, lies) == pytest.approx(distance) or (speed <= 0.5 and lies > distance)


def test_away_from_a_wall_only_the_sideways_speed_counts():
    place = by_the_wall(1, -1, 1.0, 1.3)
    away = rules.limit_to_fence((0.0, 6.0, 0.0), place, LOW, HIGH)
    beside = rules.limit_to_fence((6.0, 0.0, 0.0), place, LOW, HIGH)
    assert away[1] == pytest.approx(beside[0])
    assert rules.limit_to_fence((0.0, -6.0, 0.0), place, LOW, HIGH)[1] > -0.5 * away[1]


@pytest.mark.parametrize(("axis", "sign"), WALLS)
def test_along_a_wall_far_ends_at_the_throw_distance(axis, sign):
    height = 1.3
    above = height + rules.RECHECK_DISTANCE
    reach = aside(above) * 3.0 * (sqrt(2 * above / 9.81) + 0.4) + 0.3 + rules.RECHECK_DISTANCE
    for beyond, far in ((-1e-9, False), (1e-9, True)):
        place = by_the_wall(axis, sign, reach + beyond, height)
        assert rules.is_far_from_fence(along(axis, 3.0), place, LOW, HIGH) == far


@pytest.mark.parametrize(("axis", "sign"), WALLS)
def test_towards_a_wall_far_ends_at_the_throw_distance(axis, sign):
    height, velocity = 1.3, [0.0, 0.0, 0.0]
    velocity[axis] = 1.5 * sign
    falls = sqrt(2 * (height + rules.RECHECK_DISTANCE) / 9.81)
    reach = 1.5 * (falls + 0.4 + 0.2 + 0.3) + 0.3 + rules.RECHECK_DISTANCE
    for beyond, far in ((-1e-9, False), (1e-9, True)):
        place = by_the_wall(axis, sign, reach + beyond, height)
        assert rules.is_far_from_fence(tuple(velocity), place, LOW, HIGH) == far


def test_the_higher_it_flies_the_slower_it_is_beside_a_wall():
    speeds = [
        hypot(*rules.limit_to_fence((6.0, 0.0, 0.0), by_the_wall(1, -1, 1.5, 0.01 * k), LOW, HIGH))
        for k in range(40, 230)
    ]
    assert speeds == sorted(speeds, reverse=True)
    assert speeds[0] > 1.3 * speeds[-1]


@pytest.mark.parametrize("height", [nan, inf, 5.0, 1e9])
def test_a_fall_from_an_unknown_height_is_a_long_one(height):
    assert rules.fall_time(height) == sqrt(2.0 / 9.81 * 5.0)


def test_from_the_floor_there_is_no_fall():
    assert rules.fall_time(-0.35) == rules.fall_time(-2.0) == 0.0


def test_at_creep_speed_a_near_wall_does_not_count():
    near = (LOW[0] + rules.RECHECK_DISTANCE + 0.01, -1.5, 1.3)
    assert rules.is_far_from_fence((0.0, rules.CREEP_SPEED, 0.0), near, LOW, HIGH)
    assert not rules.is_far_from_fence((0.0, rules.CREEP_SPEED + 1e-9, 0.0), near, LOW, HIGH)
    assert rules.limit_to_fence((0.0, 6.0, 0.0), near, LOW, HIGH) == (0.0, rules.CREEP_SPEED, 0.0)


def test_the_papers_flight_is_not_slowed_by_its_walls():
    """The paper's flight asks for 4.83 m/s at 2.07 m from the wall, and presses on the board."""
    for velocity, position in (
        ((-0.05, -4.83, -0.06), (-0.93, 3.4, 0.74)),
        ((0.59, 0.0, 0.0), (7.5, -6.42, 0.7)),
        ((0.08, 0.0, 0.0), (8.135, -6.42, 0.7)),
        ((2.0, -2.0, 0.0), (0.9, -4.6, 0.7)),
    ):
        assert rules.limit_to_fence(velocity, position, LOW, HIGH) == velocity


def test_where_the_robot_is_slowed_along_a_wall_it_is_not_far():
    for speed in (0.4, 0.6, 0.9, 1.1, 2.0, 3.0, 4.4):
        for k in range(300):
            velocity, position = (0.0, speed, 0.0), (-3.0 + 0.01 * k, -3.0, 1.3)
            if rules.is_far_from_fence(velocity, position, LOW, HIGH):
                assert rules.limit_to_fence(velocity, position, LOW, HIGH) == pytest.approx(
                    velocity
                )
    assert rules.is_far_from_fence((0.0, 0.4, 0.0), (-3.0 + 0.46, -3.0, 1.3), LOW, HIGH)
    assert rules.limit_to_fence((0.0, -4.4, 0.0), (-1.0, 0.0, 0.7), LOW, HIGH) == (0.0, -4.4, 0.0)
