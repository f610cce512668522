# SPDX-License-Identifier: Apache-2.0

"""`cloud.answers: arrival`: a command for newer telemetry, neither too often nor too rarely."""

import numpy as np
import pytest

from cloudrc.results.metrics.budget import budget_of
from tests.flights.conftest import both_ways, fly

pytestmark = pytest.mark.usefixtures("shared_files")

MS = 1_000_000
ARRIVAL = "cloud.answers=arrival"
BRIEF = "link.profile=ideal", "mission.waypoints.0.dwell_s=4"


def means(flight):
    stages = budget_of(flight).document["stages"]
    return {name: round(each["mean"] * 1e3, 1) for name, each in stages.items()}


@pytest.mark.parametrize(("compute", "most"), [(0, 0.2), (7, 0.2), (14, 6.0)])
def test_no_telemetry_waits_for_a_period_but_for_a_computation(compute, most):
    """33 ms up and 33 ms down; the step adds up to 2 ms, a computation of 14 ms a wait for it."""
    settings = *BRIEF, *both_ways(delay_ms=33), f"cloud.compute_ms={compute}"
    found = means(fly("hover", *settings, ARRIVAL).flight)
    assert 0 <= found["queue"] <= most
    assert found.get("compute", 0) == compute
    assert sum(found.values()) == pytest.approx(66 + compute + found["queue"], abs=2.0)
    by_period = means(fly("hover", *settings).flight)
    assert sum(by_period.values()) >= sum(found.values()) + (1.0 if compute < 10 else 0.0)


@pytest.mark.parametrize("settings", [both_ways(delay_ms=40, jitter_ms=15), both_ways(loss=0.4)])
def test_commands_are_half_a_period_to_one_and_a_half_apart(settings):
    flight = fly("hover", *BRIEF, *settings, ARRIVAL).flight
    made_ns = np.diff(flight.during("/delay_estimate")["stamp_ns"])
    assert made_ns.min() == 5 * MS
    assert made_ns.max() == 15 * MS
    assert set(made_ns.tolist()) != {10 * MS}


def test_by_default_a_command_is_made_in_each_period():
    flight = fly("hover", *BRIEF, *both_ways(delay_ms=40, jitter_ms=15)).flight
    assert set(np.diff(flight.during("/delay_estimate")["stamp_ns"]).tolist()) == {10 * MS}
