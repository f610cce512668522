"""A new contact is reported once, with the velocities just before it."""

import pytest

from cloudrc.messages import ZERO
from cloudrc.world.low_level import LowLevel
from cloudrc.world.rotors import STOPPED
from cloudrc.world.simulator import Simulator

STEP = 0.002


def fly(simulator, low_level, reference, duration):
    """Follow a velocity [m/s] for a duration [s]; return the contacts."""
    for _ in range(round(duration / STEP)):
        simulator.step(low_level.update(simulator.readings, reference))
    return simulator.take_contacts()


@pytest.fixture
def at_the_board(scene_at):
    """The robot hovers with its tip about 6 cm before the board."""
    simulator, low_level = Simulator("pelican", scene_at(8.07, -6.42, 0.9)), LowLevel()
    assert fly(simulator, low_level, ZERO, 0.3) == []
    return simulator, low_level


def test_the_tip_touches_the_board_once_and_feels_it(at_the_board):
    simulator, low_level = at_the_board
    (touch,) = fly(simulator, low_level, (0.2, 0.0, 0.0), 2.0)
    assert (touch.body, touch.tip) == ("board", True)
    # A level robot would be at 8.135; nose down by 2 deg, the tip is 6 mm farther ahead.
    assert touch.position[0] == pytest.approx(8.132, abs=0.005)
    assert 0.05 < touch.velocity[0] < 0.25
    assert touch.tip_velocity[0] == pytest.approx(touch.velocity[0], abs=0.03)


def test_the_steady_force_is_what_statics_says(at_the_board):
    # Wanted: 4 * .2 N + .1 N from the integral, a tilt of .9 / 10.3 = .0874. The arm's weight adds
    # .0196, the force itself takes .17 F (its lever is .17 m, k_R = 1): F = 10.4 (.107 - .17 F).
    simulator, low_level = at_the_board
    fly(simulator, low_level, (0.2, 0.0, 0.0), 5.0)
    assert simulator.tip_force() == pytest.approx(0.40, abs=0.04)
    assert simulator.readings.velocity == pytest.approx(ZERO, abs=0.002)


def test_a_contact_is_new_after_0_1_s_without_one(at_the_board):
    simulator, low_level = at_the_board
    assert len(fly(simulator, low_level, (0.2, 0.0, 0.0), 1.0)) == 1
    assert fly(simulator, low_level, (-0.2, 0.0, 0.0), 1.0) == []
    assert simulator.tip_force() == 0.0
    (again,) = fly(simulator, low_level, (0.2, 0.0, 0.0), 2.0)
    assert (again.body, again.tip) == ("board", True)


def test_the_velocity_of_the_tip_includes_the_rotation(scene_at):
    # With two rotors it tips over its nose, and the tip falls faster than the base.
    simulator = Simulator("pelican", scene_at(0, 0, 0.6, "empty"))
    touches = []
    while not touches:
        simulator.step((0.0, 350.0, 500.0, 350.0))
        touches = simulator.take_contacts()
    touch = touches[0]
    assert (touch.body, touch.tip) == ("floor", True)
    assert touch.tip_velocity[2] < touch.velocity[2] - 0.3


@pytest.mark.parametrize(
    ("spawn", "reference", "body", "tip"),
    [
        ((-1.0, 0.0, 0.7), (0.5, 0.0, 0.0), "pipe_1", True),
        ((-1.0, 0.0, 0.7), (-0.5, 0.0, 0.0), "pipe_1", False),
        ((5.66, -6.42, 0.7), (0.0, 0.5, 0.0), "pipe_3", False),
    ],
)
def test_a_contact_names_the_touched_pipe(scene_at, spawn, reference, body, tip):
    simulator = Simulator("pelican", scene_at(*spawn))
    touch = fly(simulator, LowLevel(), reference, 2.0)[0]
    assert (touch.body, touch.tip) == (body, tip)


def test_the_floor_is_a_new_contact_only_after_a_flight():
    simulator, low_level = Simulator("pelican", "empty"), LowLevel()
    for _ in range(200):
        simulator.step(STOPPED)
    assert fly(simulator, low_level, (0.0, 0.0, 0.5), 1.0) == []
    landing = fly(simulator, low_level, (0.0, 0.0, -0.5), 2.0)
    assert [(touch.body, touch.tip) for touch in landing] == [("floor", False)]
    assert landing[0].velocity[2] == pytest.approx(-0.5, abs=0.1)


def test_a_reset_forgets_contacts(at_the_board):
    simulator, low_level = at_the_board
    for _ in range(500):
        simulator.step(low_level.update(simulator.readings, (0.2, 0.0, 0.0)))
    simulator.reset()
    assert simulator.take_contacts() == []
