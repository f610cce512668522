"""The capacity is the largest fleet in which all robots succeed that succeed alone."""

import pytest

from cloudrc.record.columns import Recording, RecordStore
from cloudrc.report.document import Run
from cloudrc.report.write import assess
from cloudrc.runs.fleet import assemble_fleet
from cloudrc.studies.capacity import Condition, Sought, capacity_of, search

SHORT = (
    *("mission.steps.count=8", "mission.steps.period_s=0.5"),
    *("criteria.settle_m=10", "criteria.time_limit_s=6"),
)
DEAF = "fleet.vary=[{world.odometry_rate_hz: 100}, {link.both.loss: 1}]"


def flight(robots, *settings):
    asked = Sought("steps", (*SHORT, *settings), 300, ["fifo:20"], [], 1, 4)
    return Condition(asked, "fifo:20", "").flight(robots)


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
    row = flight(2, DEAF).play()
    assert row["verdict"] == "success"
    assert row["numbers"]["fail_alone"] == 1


@pytest.mark.parametrize("robots", [1, 2])
def test_a_fleet_that_is_stopped_has_the_verdict_of_a_whole_flight(robots):
    asked = flight(robots)
    row = asked.play()
    members = [each.model_copy(update={"seed": 1}) for each in asked.fly.args[0]]
    stores = [RecordStore() for _ in members]
    whole = assemble_fleet(asked.experiment, members, [s.add for s in stores])
    whole.fly([])
    verdicts = [
        assess(Recording(records=store), robot, Run("virtual", "virtual")).verdict
        for store, robot in zip(stores, members, strict=True)
    ]
    succeeds = all(each.outcome == "success" for each in verdicts)
    assert (row["verdict"] == "success") is succeeds is (robots == 1)
    assert (row["numbers"]["flown_s"] < 0.7 * whole.now_ns * 1e-9) is not succeeds
