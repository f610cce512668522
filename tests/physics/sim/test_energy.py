# SPDX-License-Identifier: Apache-2.0

"""The energy of rotors is that of a hover computed by hand, and absent if a part is unknown."""

from math import sqrt

import numpy as np
import pytest

from cloudrc.config.load import load_experiment
from cloudrc.config.overrides import parse_settings
from cloudrc.config.resolved import ResolvedGuard
from cloudrc.config.robot import find_robot
from cloudrc.config.shipped import file_of
from cloudrc.flight.in_memory import fly_in_memory
from cloudrc.physics.sim.energy import power_factors
from cloudrc.physics.sim.scene import compile_model
from cloudrc.robots.build import build_robot
from cloudrc.robots.pelican.rotors import THRUST_COEFFICIENT

POINT = "mission.waypoints=[{position_m: [0, 0, 1], tolerance_m: 0.2, dwell_s: 4}]"


def fly(robot, *settings):
    return fly_in_memory(
        load_experiment("hover", parse_settings([f"world.robot={robot}", POINT, *settings]))
    )


@pytest.mark.parametrize(
    ("robot", "mass", "torque_ratio", "coefficient", "factor"),
    [
        ("pelican", 1.06, 0.016, THRUST_COEFFICIENT, 1.0),
        ("nano", 0.027, 0.006, 0.0662 / 1862**2, 1.0),
        ("x2", 1.3, 0.02, 5.57e-6, 0.8),  # weaker rotors turn faster for the same thrust
    ],
)
def test_a_hover_needs_the_torque_times_the_speed_of_each_rotor(
    robot, mass, torque_ratio, coefficient, factor
):
    flown = fly(robot, f"world.plant.actuator_factor={factor}")
    thrust = mass * 9.8066 / 4
    power = 4 * torque_ratio * thrust * sqrt(thrust / (factor * coefficient))
    rows = flown.flight.recording["/energy"]
    late = rows["stamp_ns"] >= rows["stamp_ns"][-1] - 2_500_000_000
    energy, stamps_ns = rows["energy"][late], rows["stamp_ns"][late]
    measured = (energy[-1] - energy[0]) / ((stamps_ns[-1] - stamps_ns[0]) * 1e-9)
    assert measured == pytest.approx(power, rel=0.01)
    numbers = flown.numbers
    assert numbers["rotor_energy"].value == pytest.approx(
        power * numbers["duration"].value, rel=0.05
    )


def test_a_robot_without_rotors_has_no_energy():
    assert build_robot(load_experiment("pillars").world, ResolvedGuard()).simulator.meter is None


def test_rotors_of_unknown_speed_or_torque_have_no_power():
    model = compile_model(find_robot("x2").model, file_of("empty"))
    assert power_factors(model, model, None) is None
    assert power_factors(model, model, 5.57e-6) == pytest.approx(np.full(4, 0.02 / sqrt(5.57e-6)))
    model.actuator_gear[0, 5] = 0.0
    assert power_factors(model, model, 5.57e-6) is None
