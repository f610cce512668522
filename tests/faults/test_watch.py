"""The watch itself: what it calls a breach, and what not."""

import pytest

from cloudrc.faults.invariants import Watch, stops
from cloudrc.messages import ZERO, GuardState
from cloudrc.records import Contact
from tests.faults.conftest import World

MS = 1_000_000
INSIDE, OUTSIDE = (1.0, 1.0, 1.0), (9.3, 1.0, 1.0)
GROUND, TRACK, HOLD, LAND, ESTOP = GuardState


@pytest.mark.parametrize("state", GuardState)
def test_a_base_outside_the_fence_is_a_breach_in_any_state(state):
    assert World().tick(ZERO, state=state) == set()
    assert World().tick(ZERO, state=state, position=OUTSIDE) == {"fence"}


def test_an_operator_stop_allows_only_a_short_fall_outside():
    world, far = World(), (9.2 + 1.51, 1.0, 1.0)
    world.guard.stop(0)
    assert world.tick(ZERO, state=ESTOP, position=OUTSIDE) == set()
    assert world.watch.fallen == pytest.approx(0.1)
    assert world.tick(ZERO, state=GROUND, position=OUTSIDE) == set(), "acknowledged where it lies"
    assert world.tick(ZERO, state=TRACK, position=OUTSIDE) == {"fence"}
    world = World()
    world.guard.stop(0)
    assert world.tick(ZERO, state=ESTOP, position=far) == {"fence"}


@pytest.mark.parametrize(("speed", "kinds"), [(0.11, set()), (0.13, {"fence"})])
def test_after_an_operator_stop_no_take_off_while_falling(speed, kinds):
    world = World()
    world.guard.stop(0)
    world.readings.velocity = (0.0, 0.0, -speed)
    assert world.tick(ZERO, state=ESTOP) == set()
    assert world.tick(ZERO, state=TRACK) == kinds
    world.readings.velocity = (0.0, 0.0, 1.0)
    assert world.tick(ZERO, state=TRACK) == kinds


@pytest.mark.parametrize("state", [GROUND, LAND, ESTOP])
def test_a_word_that_stops_no_rotors_excuses_no_fall(state):
    """Stopped by a hit, it falls; what is said to it later has not brought that about."""
    world = World()
    world.guard.state = ESTOP
    world.guard.stop(0)
    assert world.tick(ZERO, state=state, position=OUTSIDE) == {"fence"}
    assert world.watch.fallen == 0.0


def test_a_hit_allows_only_a_short_fall_outside():
    world, far = World(), (9.2 + 1.51, 1.0, 1.0)
    assert world.tick(ZERO, state=TRACK) == set()
    assert world.tick(ZERO, state=ESTOP, position=OUTSIDE) == set()
    world.guard.stop(0)  # what is said to it now has not brought that about
    assert world.tick(ZERO, state=GROUND, position=OUTSIDE) == set(), "acknowledged where it lies"
    assert (world.watch.thrown, world.watch.fallen) == (pytest.approx(0.1), 0.0)
    assert world.tick(ZERO, state=TRACK, position=OUTSIDE) == {"fence"}
    world = World()
    assert world.tick(ZERO, state=TRACK) == set()
    assert world.tick(ZERO, state=ESTOP, position=far) == {"fence"}


def test_a_breach_says_how_long_before_something_was_hit():
    world = World()
    contact = Contact(0, "board", INSIDE, ZERO, ZERO, False)
    world.watch.see(contact, TRACK, honest=False)
    world.tick(ZERO, position=OUTSIDE)
    assert [breach.text for breach in world.watch.breaches] == [
        "base at (9.30, 1.00, 1.00), 0.00 s after it hit board"
    ]


@pytest.mark.parametrize(
    ("reference", "kinds"),
    [((0.02, 0.013, 0.0), set()), ((0.02, 0.014, 0.0), {"cap"}), ((6.001, 0.0, 0.0), {"cap"})],
)
def test_the_reference_grows_no_faster_than_the_cap(reference, kinds):
    assert World().tick(reference) == kinds


@pytest.mark.parametrize("yaw_rate", [-1.0, 1.001, -1.001, float("nan")])
def test_the_reference_turns_no_faster_than_the_cap(yaw_rate):
    assert World(yaw_rate).tick(ZERO) == (set() if yaw_rate == -1.0 else {"cap"})


def test_braking_may_be_instant_and_exceed_the_cap():
    assert World().tick((0.02, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, -0.02, 0.0)) == set()
    assert World().tick((0.1, 0.0, 0.0), state=HOLD) == set()
    assert World().tick((0.02, 0.0, 0.0), (-0.025, 0.0, 0.0)) == {"cap"}


def test_what_cannot_stop_is_found_in_flight_only():
    near = (8.9, 1.0, 1.0)  # 0.2 v + v^2/6 <= 0.2: 0.647 m/s
    assert World().tick((0.64, 0.0, 0.0), state=HOLD, position=near) == set()
    assert World().tick((0.66, 0.0, 0.0), state=HOLD, position=near) == {"stop"}
    assert World().tick((0.66, 0.0, 0.0), state=ESTOP, position=near) == set()


def test_the_floor_is_a_face_unless_the_robot_lands():
    low = (1.0, 1.0, 0.5)  # 0.2 v + v^2/6 <= 0.4: 1.061 m/s
    assert World().tick((0.0, 0.0, -1.06), state=HOLD, position=low) == set()
    assert World().tick((0.0, 0.0, -1.07), state=HOLD, position=low) == {"stop"}
    assert World().tick((0.0, 0.0, -1.07), state=LAND, position=low) == set()
    assert World().tick((9.0, 0.0, -1.07), state=LAND, position=low) == {"stop", "cap"}
    assert World().tick(ZERO, state=LAND, position=(1.0, 1.0, -0.01)) == {"fence"}


def test_track_is_for_fresh_commands():
    world = World()
    assert world.tick(*[ZERO] * 126) == set()
    assert world.tick(ZERO) == {"stale"}


def test_every_step_is_ruled_by_a_tick_of_the_guard():
    world = World()
    assert world.tick(ZERO, ZERO) == set()
    assert world.tick(ZERO, ruled=False) == {"tick"}


@pytest.mark.parametrize("state", [GROUND, ESTOP])
def test_rotors_stand_still_on_the_ground_and_after_a_stop(state):
    assert World().tick(ZERO, state=state) == set()
    assert World().tick(ZERO, state=state, turns=True) == {"latch"}


@pytest.mark.parametrize("state", [HOLD, LAND])
def test_a_robot_that_is_left_alone_stops_where_it_can(state):
    world = World()  # at rest: 0.5 m
    world.tick(ZERO, state=state)
    assert world.tick(ZERO, state=state, position=(1.49, 1.0, 1.0)) == set()
    assert world.tick(ZERO, state=state, position=(1.0, 0.49, 1.0)) == {"rest"}
    world = World()  # 2 m/s: 0.4 + 0.67 m more
    world.readings.velocity = (0.0, 2.0, 0.0)
    world.tick(ZERO, state=state)
    assert world.tick(ZERO, state=state, position=(1.0, 2.56, 1.0)) == set()
    assert world.tick(ZERO, state=TRACK, position=(1.0, 2.6, 1.0)) == set()
    assert world.tick(ZERO, state=state, position=(1.0, 2.6, 1.0)) == set(), "flown on since"
    assert world.tick(ZERO, state=state, position=(1.0, 4.17, 1.0)) == {"rest"}


def test_a_hit_excuses_drift_until_the_next_flight():
    world, pipe = World(), Contact(-2_000_000_000, "pipe_1", INSIDE, ZERO, ZERO, False)
    world.tick(ZERO, state=HOLD)
    world.watch.see(pipe, HOLD, honest=False)
    assert world.tick(ZERO, state=HOLD, position=(3.0, 1.0, 1.0)) == set()
    for state in (TRACK, HOLD):
        world.tick(ZERO, state=state, position=(3.0, 1.0, 1.0))
    assert world.tick(ZERO, state=HOLD, position=(5.0, 1.0, 1.0)) == {"rest"}


@pytest.mark.parametrize(
    ("speed", "below", "above", "can"),
    [
        (0.0, 0.0, 0.0, True),
        (1.0, 0.0, 0.47, True),
        (1.0, 9.0, 0.46, False),
        (-1.0, 0.47, 0.0, True),
        (-1.0, 0.46, 9.0, False),
    ],
)
def test_stopping_counts_towards_the_face_ahead(speed, below, above, can):
    assert stops(speed, below, above) == can


@pytest.mark.parametrize(
    ("body", "tip", "state", "kinds"),
    [
        ("board", True, TRACK, set()),
        ("board", False, TRACK, {"collision"}),
        ("pipe_1", True, TRACK, {"collision"}),
        ("floor", False, HOLD, {"collision"}),
        ("floor", False, LAND, set()),
    ],
)
def test_with_an_honest_cloud_only_the_tip_touches_the_board(body, tip, state, kinds):
    for honest, found in ((True, kinds), (False, set())):
        watch = Watch(6.0, 12.0, 1.0, 250 * MS)
        watch.see(Contact(0, body, INSIDE, ZERO, ZERO, tip), state, honest)
        assert set(watch.counts) == found


def test_only_a_landing_robot_may_touch_what_is_below():
    world = World()
    pipe = Contact(0, "pipe_3", INSIDE, ZERO, ZERO, False)
    world.tick(ZERO, state=ESTOP)
    world.watch.see(pipe, ESTOP, honest=True)
    assert (set(world.watch.counts), world.watch.landed_on) == ({"collision"}, set())
    world = World()
    world.tick((0.0, 0.0, -0.5), state=LAND)
    for state in (LAND, ESTOP, GROUND):  # and if it hits it hard, or slides off
        world.tick(ZERO, state=state)
        world.watch.see(pipe, state, honest=True)
    assert (set(world.watch.counts), world.watch.landed_on) == (set(), {"pipe_3"})
    world = World()
    world.tick(ZERO, state=TRACK)
    world.guard.stop(0)
    world.watch.see(pipe, ESTOP, honest=True)
    assert (set(world.watch.counts), world.watch.landed_on) == (set(), {"pipe_3"})
    world.tick(ZERO, state=TRACK)
    for state in (TRACK, HOLD, ESTOP):
        world.watch.counts.clear()
        world.watch.see(pipe, state, honest=True)
        assert set(world.watch.counts) == {"collision"}


def test_after_a_hit_or_without_rotors_no_rest_is_required():
    away = (3.0, 1.0, 1.0)
    for hit_ns, kinds in ((0, set()), (-1_000_000_000, {"rest"})):
        world = World()
        world.watch.see(Contact(hit_ns + 2 * MS, "pipe_3", INSIDE, ZERO, ZERO, False), TRACK, False)
        world.tick(ZERO)
        world.tick(ZERO, state=HOLD)
        assert world.tick(ZERO, state=HOLD, position=away) == kinds
    world = World()
    world.tick(ZERO)
    world.tick(ZERO, state=HOLD)
    assert world.tick(ZERO, state=LAND, position=away, turns=False) == set()
    assert world.tick(ZERO, state=LAND, position=away) == {"rest"}
