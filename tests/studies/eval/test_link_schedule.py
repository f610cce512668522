# SPDX-License-Identifier: Apache-2.0

"""What an evaluation tells of the schedule that it met."""

import json

import pytest

from cloudrc.gym.step import StepTime
from cloudrc.link.library import read_profile
from cloudrc.studies.eval.link_schedule import describe_met, find_met
from cloudrc.studies.eval.setup import EvalSetup

STEP = StepTime(0.02, "given")


def row(start, steps):
    return {"link_start": start, "numbers": {"steps": steps}, "point": {"executor": "newest"}}


def test_the_episodes_that_met_a_handover_are_told():
    rows = [row(0.5, 500), row(9.0, 40), row(25.0, 500), row(19.9, 1)]
    found = find_met(EvalSetup("E", "p", link="handover", step=STEP), rows)
    assert found["met"] == [(0.0, 10.5), pytest.approx((19.9, 19.92)), (25.0, 30.0)]
    assert [each["met"] for each in found["events"]] == [1, 0]
    told = [*describe_met(found)]
    assert told[1] == "outage at 10 s (0.05 s): met by 1 of 4 episodes"
    assert told[2] == "no episode met the outage at 20 s (0.3 s): the longest has 10.0 s"


def test_an_episode_meets_an_event_of_the_next_pass():
    found = find_met(EvalSetup("E", "p", link="handover", step=STEP), [row(29.0, 600)])
    assert [each["met"] for each in found["events"]] == [1, 0]


def test_a_link_that_does_not_change_has_no_schedule():
    assert find_met(EvalSetup("E", "p", link="lte", step=STEP), [row(0.0, 500)]) is None


def test_the_outages_that_episodes_of_cartpole_meet_are_told(law, evaluate, tmp_path):
    out, link = tmp_path / "o", tmp_path / "outages.yaml"
    link.write_text(
        "uplink: {repeat_s: 4, blackouts: [{start_s: 1, duration_s: 0.1}, {start_s: 2,"
        " duration_s: 1.5}]}\n"
    )
    evaluate(*"--seeds 8 --max-steps 60 --link".split(), link, "--policy", law(), "--out", out)
    rows = [json.loads(line) for line in (out / "rows.jsonl").read_text().splitlines()]
    rows = [each for each in rows if each["point"]["executor"] == "newest"]
    starts = [each["link_start"] for each in rows]
    assert len({*starts}) == 8
    assert all(0.0 < start < 4.0 for start in starts)
    document = json.loads((out / "eval.json").read_text())
    ends = [
        start + each["numbers"]["steps"] * 0.02 for start, each in zip(starts, rows, strict=True)
    ]
    for event in document["time_line"]["events"]:
        begins = event["begin"], event["begin"] + 4.0
        length = event["end"] - event["begin"]
        drawn = sum(
            any(begin < end and start < begin + length for begin in begins)
            for start, end in zip(starts, ends, strict=True)
        )
        assert 0 < event["met"] == drawn < 8
    assert any(note.startswith("link schedule of 4 s: ") for note in document["notes"])


def test_a_profile_is_known_by_where_it_begins(tmp_path):
    (tmp_path / "p.yaml").write_text("uplink: {repeat_s: 4, changes: [{at_s: 1, delay_ms: 9}]}\n")
    path = str(tmp_path / "p.yaml")
    before = EvalSetup("E", "ws://h:1", link=path).identity()["link"]
    (tmp_path / "p.yaml").write_text((tmp_path / "p.yaml").read_text() + "start_s: 2\n")
    assert EvalSetup("E", "ws://h:1", link=path).identity()["link"] != before
    assert read_profile(path).start_s == 2.0


@pytest.mark.parametrize("length", [1, 400])
def test_a_line_without_a_period_is_told(tmp_path, length):
    (tmp_path / "p.yaml").write_text("uplink: {changes: [{at_s: 5, delay_ms: 9}]}\n")
    setup = EvalSetup("E", "p", link=str(tmp_path / "p.yaml"), step=STEP)
    told = [*describe_met(find_met(setup, [row(0.0, length)]))]
    assert told[0].startswith("link schedule: 0 to ")
    assert ("no episode" in told[1]) is (length == 1)
