# SPDX-License-Identifier: Apache-2.0

"""Rotors and drag follow their formulas, contacts are found, replay is equal bit by bit."""

from array import array

import pytest

from cloudrc.physics.sim.readings import Readings
from cloudrc.physics.sim.simulator import replay, sensor_reader
from cloudrc.robots.pelican.low_level import LowLevel
from cloudrc.robots.pelican.rotors import STOPPED
from cloudrc.wire.messages import UPRIGHT, ZERO
from tests.world.conftest import simulate


def fly(simulator, low_level, reference, duration):
    """Follow a velocity [m/s] for a duration [s]; return the contacts."""
    for _ in range(round(duration / simulator.dt)):
        simulator.step(low_level.update(simulator.readings, reference))
    return simulator.take_contacts()


def test_it_stands_at_its_spawn_and_falls_from_the_air(scene_at):
    simulator = simulate("pelican", "pipes")
    assert simulator.readings == Readings.of((0.0, 0.0, 0.1, *UPRIGHT), (*ZERO, *ZERO))
    falling = simulate("pelican", scene_at(0, 0, 5, "empty"))
    for _ in range(100):
        simulator.step((0.0,) * 4)
        falling.step((0.0,) * 4)
    assert simulator.readings.position == pytest.approx((0, 0, 0.1), abs=1e-3)
    assert simulator.take_contacts() == []
    assert falling.readings.velocity[2] == pytest.approx(-9.8066 * 0.2, rel=1e-4)
    assert falling.take_contact_force() == (0.0, 0.0, 0.0)


def test_a_velocity_is_followed(scene_at):
    simulator = simulate("pelican", scene_at(0, 0, 3, "empty"))
    fly(simulator, LowLevel(integral_limit_xy=0.3), (0.5, -0.3, 0.2), 8.0)
    assert simulator.readings.velocity == pytest.approx((0.5, -0.3, 0.2), abs=0.05)
    # The arm's moment of .01 kg * .2 m * 9.81 m/s^2 tilts the robot by .0196 rad (k_R = 1),
    # that is .204 N forward. The integral takes .1 N; the rest drives it at 4 v = .104 N.
    simulator.reset()
    fly(simulator, LowLevel(integral_limit_xy=0.1), ZERO, 10.0)
    assert simulator.readings.velocity == pytest.approx((0.026, 0.0, 0.0), abs=0.002)


@pytest.mark.parametrize("addresses", [[], [0], [1, 2, 4], [4, 0], [3, 3]])
def test_sensors_are_read_in_their_own_order_whatever_that_of_mujoco(addresses):
    values = array("d", [0.5, 1.5, 2.5, 3.5, 4.5])
    read = sensor_reader(memoryview(values), addresses)
    values[4] = -1.0  # the present value counts
    assert read() == tuple(values[each] for each in addresses)


@pytest.mark.parametrize("before", [0.2, 1.5])
def test_the_tape_replays_to_the_same_bits_through_contact(scene_at, before):
    # The tape starts before the tip touches the board, or while it presses on it.
    simulator, low_level = simulate("pelican", scene_at(8.0, -6.42, 0.9)), LowLevel()
    fly(simulator, low_level, (0.2, 0.0, 0.0), before)
    assert (simulator.take_contact_force()[0] > 0.0) == (before > 1.0)
    start, simulator.tape = simulator.state(), []
    touches = fly(simulator, low_level, (0.2, 0.05, 0.0), 2.0)
    assert [touch.body for touch in touches] == ["board"] * (before < 1.0)
    assert len(simulator.tape) == 1000
    end = simulator.state()[0].tobytes()
    assert replay(simulator.model, *start, simulator.tape).tobytes() == end
    # The drag on the tape matters: without it the end state differs.
    still = [(*controls[:4], *(0.0,) * 6) for controls in simulator.tape]
    assert replay(simulator.model, *start, still).tobytes() != end


# A contact is reported once, with the velocities just before it.


@pytest.fixture
def at_the_board(scene_at):
    """The robot hovers with its tip about 6 cm before the board."""
    simulator, low_level = simulate("pelican", scene_at(8.07, -6.42, 0.9)), LowLevel()
    assert fly(simulator, low_level, ZERO, 0.3) == []
    return simulator, low_level


def test_the_tip_touches_the_board_and_again_after_0_1_s_without(at_the_board):
    simulator, low_level = at_the_board
    (touch,) = fly(simulator, low_level, (0.2, 0.0, 0.0), 2.0)
    assert (touch.body, touch.by_probe) == ("board", True)
    # A level robot would be at 8.135; nose down by 2 deg, the tip is 6 mm farther ahead.
    assert touch.position[0] == pytest.approx(8.132, abs=0.005)
    assert 0.05 < touch.velocity[0] < 0.25
    assert touch.touch_velocity[0] == pytest.approx(touch.velocity[0], abs=0.03)
    assert fly(simulator, low_level, (-0.2, 0.0, 0.0), 1.0) == []
    assert simulator.take_contact_force()[0] == 0.0
    (again,) = fly(simulator, low_level, (0.2, 0.0, 0.0), 2.0)
    assert (again.body, again.by_probe) == ("board", True)


def test_peak_force_and_impulse_of_the_probe_include_every_step(at_the_board):
    simulator, low_level = at_the_board
    taken, every = [], []
    for _ in range(100):
        for _ in range(5):
            fly(simulator, low_level, (0.2, 0.0, 0.0), simulator.dt)
            every.append(float(simulator.data.sensordata[0]))
        taken.append(simulator.take_contact_force())
    force, peak, impulse = zip(*taken, strict=True)
    assert force == tuple(every[4::5])
    assert max(peak) == max(every) > 10.0
    assert sum(impulse) == pytest.approx(sum(every) * simulator.dt)
    assert simulator.take_contact_force() == (every[-1], 0.0, 0.0)


def test_the_floor_is_a_new_contact_only_after_a_flight():
    simulator, low_level = simulate("pelican", "empty"), LowLevel()
    for _ in range(200):
        simulator.step(STOPPED)
    assert fly(simulator, low_level, (0.0, 0.0, 0.5), 1.0) == []
    landing = fly(simulator, low_level, (0.0, 0.0, -0.5), 2.0)
    assert [(touch.body, touch.by_probe) for touch in landing] == [("floor", False)]
    assert landing[0].velocity[2] == pytest.approx(-0.5, abs=0.1)
