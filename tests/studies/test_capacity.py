# SPDX-License-Identifier: Apache-2.0

"""The capacity is the largest fleet in which all robots succeed that succeed alone."""

import pytest

from cloudrc.flight.trials.fleet import plan_fleet
from cloudrc.studies.capacity import capacity_of, search

SHORT = (
    *("mission.steps.count=8", "mission.steps.period_s=0.5"),
    *("criteria.settle_m=10", "criteria.time_limit_s=6"),
    *("cell.rate_kbit=300", "cell.queue_packets=20"),
)
DEAF = "fleet.vary=[{world.odometry_rate_hz: 100}, {link.both.loss: 1}]"


def fly(robots, *settings, until_failure=True):
    settings = *SHORT, *settings, f"fleet.robots={robots}"
    return plan_fleet("steps", settings, {}, until_failure=until_failure).play()


@pytest.mark.parametrize("start", [1, 5, 40, 100])
@pytest.mark.parametrize("largest", [0, 1, 5, 13, 63, 64])
def test_the_search_finds_where_success_ends_within_a_few_fleets(start, largest):
    tries = [*search(start, 64, lambda size: size <= largest)]
    assert max((size for size in tries if size <= largest), default=0) == largest
    assert len(tries) == len({*tries}) <= 12


def test_the_seeds_decide_the_capacity_and_one_beyond_the_flown_sizes_is_a_bound():
    seeds = range(8)  # six fail at 14, one at 12, one never
    fleets = {
        12: {seed: seed != 6 for seed in seeds},
        13: dict.fromkeys(seeds, True),
        14: {seed: seed > 5 for seed in seeds},
    }
    found = capacity_of(fleets, top=64)
    assert found["capacity"] == 13
    assert found["interval"] == [11, 14]
    assert (found["at_most"], found["at_least"]) == (11, 14)
    few = capacity_of({1: {1: True}, 2: {1: True}}, top=2)
    assert (few["capacity"], few["at_most"], few["at_least"]) == (2, None, None)
    assert few["interval_is"] == "range"


def test_a_robot_that_fails_alone_does_not_count():
    row = fly(2, DEAF)
    assert row["verdict"] == "success"
    assert row["numbers"]["fail_alone"] == 1


@pytest.mark.parametrize(("robots", "verdict"), [(1, "success"), (2, "failure")])
def test_a_fleet_that_is_stopped_has_the_verdict_of_a_whole_flight(robots, verdict):
    stopped, whole = fly(robots), fly(robots, until_failure=False)
    assert stopped["verdict"] == whole["verdict"] == verdict
    saved = stopped["numbers"]["flown_s"] / whole["numbers"]["flown_s"]
    assert (saved < 0.7) is (verdict == "failure")
