# SPDX-License-Identifier: Apache-2.0

"""Schedules of faults: in files, and random ones."""

import pytest

from tests.faults.adversary import POLICIES, choose
from tests.faults.schedule import CALM, KINDS, compose, dump, load


@pytest.mark.parametrize("draw", [compose, choose])
def test_a_drawn_schedule_is_what_its_file_says(draw, tmp_path):
    path = tmp_path / "schedule.yaml"
    for seed in range(100):
        path.write_text(dump(draw(seed), "a note\nof two lines"))
        assert load(path) == draw(seed)


def test_random_schedules_have_all_faults_and_calm_at_the_end():
    drawn = [compose(seed) for seed in range(400)]
    events = [event for schedule in drawn for event in schedule.events]
    assert {event.kind for event in events} == set(KINDS)
    assert max(event.end for event in events) <= CALM
    assert 10 < sum(not schedule.events for schedule in drawn) < 60
    assert 70 < sum(schedule.hold_max < 60.0 for schedule in drawn) < 180
    # A hostile cloud flies alone or amid faults.
    hostile = {(chosen.policy, not chosen.events) for chosen in map(choose, range(200))}
    assert hostile == {(policy, alone) for policy in POLICIES for alone in (True, False)}
