# SPDX-License-Identifier: Apache-2.0

"""One configuration over all networks: plans make the fast mission independent of the delay."""

import pytest

from tests.conftest import nightly
from tests.flights.conftest import both_ways, fly, numbers

WAYS = {"both": ("up", "down"), "up": ("up",), "down": ("down",)}
SILENT = 20.0  # [s]


def link(rtt):
    """Return settings for a round trip [ms] with jitter and 10 % loss each way."""
    return both_ways(delay_ms=rtt // 2, jitter_ms=60 if rtt == 600 else 40, loss=0.1)


@pytest.mark.full
@pytest.mark.parametrize("rtt", [200, 400, 600])
@pytest.mark.parametrize("seed", range(1, 31))
def test_after_the_first_command_the_contact_comes_when_it_comes_without_delay(rtt, seed):
    flight = fly("fast", *link(rtt), f"seed={seed}")
    assert flight.verdict.failures == ()
    n, still = numbers(flight), numbers(fly("fast", "link.profile=ideal"))
    flown, due = (each["contact_time"] - each["start_delay"] for each in (n, still))
    assert flown / due == pytest.approx(1.0, abs=0.01)
    assert n["start_delay"] == pytest.approx(rtt * 1e-3, rel=0.2), "the start takes a round trip"
    assert n["min_clearance"] >= 0.9 * still["min_clearance"]
    assert n["hold_count"] == 0


def test_plans_predict_to_4_mm_with_fast_gains():
    settings = ["mission=steps", "mission.steps.count=3", "world.scene=empty"]
    settings.append("mission.touch=null")
    flight = fly("fast", *settings, "link.profile=paper-p3", "cloud.plan_s=0.4")
    assert flight.verdict.failures == ()
    assert numbers(flight)["prediction_error_rms"] <= 0.004
    assert "delay_estimate_error_rms" not in numbers(flight), "a plan begins at its horizon"


@pytest.mark.parametrize("at", [10.5, *nightly(14.0, *(6.25 + 0.5 * k for k in range(24)))])
@pytest.mark.parametrize("way", [*nightly("both", "up"), "down"])
def test_a_silence_of_20_s_in_a_pipe_touches_nothing(at, way):
    silence = f"[{{start_s: {at}, duration_s: {SILENT}}}]"
    dark = [f"link.{each}link.blackouts={silence}" for each in WAYS[way]]
    flight = fly("fast", *link(200), *dark, "criteria.time_limit_s=90")
    assert flight.verdict.failures == ()
    assert numbers(flight)["obstacle_contacts"] == 0
