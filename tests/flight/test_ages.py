# SPDX-License-Identifier: Apache-2.0

"""How old commands become, by a simulation without a flight."""

import pytest

from cloudrc.config.load import load_experiment
from cloudrc.flight.ages import simulate_ages
from tests.flights.conftest import both_ways, fly, numbers

pytestmark = pytest.mark.usefixtures("shared_files")


def ages(*settings):
    return simulate_ages(load_experiment("steps", ["link.profile=ideal", *settings]))


def test_a_constant_delay_gives_its_round_trip_and_one_period_of_each_stream():
    """A datagram counts until the next one leaves, 10 ms later."""
    commands, confirmations = ages(*both_ways(delay_ms=40))
    assert commands == pytest.approx([0.09] * len(commands))
    assert confirmations == pytest.approx([0.09] * len(confirmations))
    assert len(commands) == pytest.approx(2000, abs=20)


def test_computing_delays_commands_and_a_blackout_does_not_count():
    slow, _ = ages(*both_ways(delay_ms=40), "cloud.compute_ms=10")
    assert slow == pytest.approx([0.1] * len(slow))
    dark, _ = ages(*both_ways(delay_ms=40), "link.uplink.blackouts=[{start_s: 1, duration_s: 5}]")
    assert max(dark) == pytest.approx(0.09)


@pytest.mark.parametrize(
    "settings",
    [
        ("cloud.compute_ms=160",),
        ("cloud.compute_ms=14", "cloud.command_rate_hz=50"),
        (*both_ways(delay_ms=43), "cloud.answers=arrival"),
        (*both_ways(delay_ms=43), "cloud.answers=arrival", "cloud.compute_ms=14"),
        (*both_ways(delay_ms=40), "cloud.compute_ms=64", "world.odometry_rate_hz=50"),
        ("cloud.compute_ms=100", "cloud.compute_deviation_ms=60"),
    ],
)
def test_the_largest_age_is_that_of_a_flight(settings):
    """Cloud computes one command after the other, so that the computing time counts twice."""
    raised = "guard.command_age_max_ms=3000", "cloud.freeze_after_s=3"
    settings = "link.profile=ideal", *settings, *raised, "mission.waypoints.0.dwell_s=8"
    expected, _ = simulate_ages(load_experiment("hover", settings))
    peak = numbers(fly("hover", *settings))["age_at_actuator_max"]
    assert peak == pytest.approx(max(expected), abs=0.0021)  # the guard looks every 2 ms


def test_without_an_arrival_there_is_no_age():
    assert ages("link.uplink.loss=1") == ([], [])
    commands, confirmations = ages("link.downlink.loss=1")
    assert commands == []
    assert confirmations == []
