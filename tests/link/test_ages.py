"""How old commands become on a link, by a simulation without a flight."""

import pytest

from cloudrc.config.load import load_experiment
from cloudrc.link.ages import simulate_ages
from tests.flights.conftest import both_ways


def ages(*settings):
    return simulate_ages(load_experiment("steps", ["link.profile=ideal", *settings]))


def test_a_constant_delay_gives_its_round_trip_and_one_period_of_each_stream():
    """A datagram counts until the next one leaves, 10 ms later."""
    commands, confirmations = ages(*both_ways(delay_ms=40))
    assert commands == pytest.approx([0.09] * len(commands))
    assert confirmations == pytest.approx([0.09] * len(confirmations))
    assert len(commands) == pytest.approx(2000, abs=20)


def test_computing_delays_commands_and_a_blackout_does_not_count():
    slow, _ = ages(*both_ways(delay_ms=40), "cloud.compute_ms=20")
    assert slow == pytest.approx([0.11] * len(slow))
    dark, _ = ages(*both_ways(delay_ms=40), "link.uplink.blackouts=[{start_s: 1, duration_s: 5}]")
    assert max(dark) == pytest.approx(0.09)


def test_without_an_arrival_there_is_no_age():
    assert ages("link.uplink.loss=1") == ([], [])
    commands, confirmations = ages("link.downlink.loss=1")
    assert commands == []
    assert confirmations == []
