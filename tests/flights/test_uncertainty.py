# SPDX-License-Identifier: Apache-2.0

"""Each uncertainty changes the flight as it should."""

import json

import pytest

from cloudrc.config.load import load_experiment
from cloudrc.flight.in_memory import fly_in_memory
from tests.flights.conftest import numbers

POINT = (0.5, 0.0, 0.9)


def waiting(*settings, seconds=1.0):
    """An experiment in which the robot flies to POINT and waits."""
    way = {"position_m": POINT, "tolerance_m": 0.5, "dwell_s": seconds}
    keys = f"mission={json.dumps({'waypoints': [way]})}", "world.scene=empty"
    link = () if any("link." in setting for setting in settings) else ("link.profile=ideal",)
    return load_experiment("paper", [*keys, *link, *settings])


def flown(*settings, seconds=1.0):
    return fly_in_memory(waiting(*settings, seconds=seconds)).flight.recording


WEIGHT, ASSUMED = 1.06 * 9.8066, 1.05 * 9.81


@pytest.mark.parametrize(
    ("key", "axis", "lacks"),
    [
        ("world.plant.mass_factor=1.2", 2, 1.2 * WEIGHT - ASSUMED),
        ("world.plant.payload_kg=0.25", 2, WEIGHT + 0.25 * 9.8066 - ASSUMED),
        ("world.plant.actuator_factor=0.8", 2, WEIGHT / 0.8 - ASSUMED),
        # The drag of four rotors at 510 rad/s, .0454 m above the centre of mass, also tilts the
        # robot: by the torque in N m (k_R = 1), and this tilts its thrust.
        ("world.wind.velocity_mps=[0, 3]", 1, 3 * 4 * 8.06428e-5 * 510.1 * (1 + 0.0454 * WEIGHT)),
    ],
)
def test_the_robot_hovers_where_the_forces_balance(key, axis, lacks):
    """Velocity loop: Kp v + Ki s, with s at its limit; cloud's P turns v into a distance."""
    gain_p, integral, gain = (4.0, 0.1, 0.8) if axis < 2 else (10.0, 1.0, 1.5)
    away = (lacks - integral) / gain_p / gain * (1 if axis < 2 else -1)
    found = flown(key, seconds=8.0)["/ground_truth"]["position"][-1]
    assert found[axis] - POINT[axis] == pytest.approx(away, rel=0.02)


def test_no_number_depends_on_the_clocks():
    clocks = ("seed=1", "cloud.clock_offset_s=86400.5", "cloud.clock_drift_ppm=-1000")
    same, later, drift = (
        numbers(fly_in_memory(waiting("link.profile=paper-p2", clock))) for clock in clocks
    )
    of_one_clock = {"uplink_delay_mean", "downlink_delay_mean", "age_of_information_mean"}
    assert same.keys() - later.keys() == of_one_clock, "unknown, not wrong"
    assert later == {name: same[name] for name in later}
    assert drift.keys() == later.keys()
    for name in ("rtt_mean", "loop_delay_mean", "duration", "tracking_rms_measured"):
        assert drift[name] == pytest.approx(later[name], rel=0.03), name
