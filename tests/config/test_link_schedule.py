# SPDX-License-Identifier: Apache-2.0

"""The start of a flight's schedule: keys, hashes, and what is told."""

from dataclasses import replace

import pytest

from cloudrc.base.outside.document import Document
from cloudrc.config.link_edit import edit_profile
from cloudrc.config.link_schedule import describe_one_schedule, find_ways, link_start
from cloudrc.config.load import load_experiment
from cloudrc.config.resolved import dump, fingerprint
from cloudrc.flight.assembly.link import build_links
from tests.config.conftest import refused_line

HANDOVER = "link.profile=handover"
RANDOM = "link.start_s=random"


def test_keys_at_their_defaults_change_no_hash():
    bare = load_experiment("fast")
    assert "start_s" not in dump(bare)
    assert "repeat_s" not in dump(bare)
    null = load_experiment("fast", ["link.start_s=null", "link.uplink.repeat_s=null"])
    assert fingerprint(null) == fingerprint(bare)


def test_flights_begin_at_0_unless_they_are_told_where():
    assert link_start(load_experiment("fast", [HANDOVER])) == 0.0
    assert link_start(load_experiment("fast", [HANDOVER, "link.start_s=9.5"])) == 9.5
    drawn = [load_experiment("fast", [HANDOVER, RANDOM, f"seed={seed}"]) for seed in (1, 2, 2)]
    first, second, again = map(link_start, drawn)
    assert 0.0 < first < 30.0
    assert first != second == again


def test_a_fleet_is_at_one_place_and_a_robot_may_have_its_own(tmp_path):
    settings = [HANDOVER, RANDOM, "fleet.robots=3"]
    vary = 'fleet.vary=[{}, {}, {"link.start_s": 4}]'
    robots = [
        load_experiment("fast", [*settings, vary, f"fleet.only={robot}"]) for robot in range(3)
    ]
    first, second, third = map(link_start, robots)
    assert first == second != third == 4.0


def test_a_resolved_flight_keeps_its_start_and_another_profile_has_its_own(tmp_path):
    (tmp_path / "late.yaml").write_text("uplink: {delay_ms: 5, repeat_s: 4}\nstart_s: 3\n")
    (tmp_path / "e.yaml").write_text(
        dump(load_experiment("fast", ["link.profile=" + str(tmp_path / "late.yaml")]))
    )
    again = load_experiment(tmp_path / "e.yaml")
    assert link_start(again) == 3.0
    assert again.uplink.repeat_s == 4.0
    assert link_start(load_experiment(tmp_path / "e.yaml", ["link.profile=lte"])) == 0.0
    assert link_start(load_experiment(tmp_path / "e.yaml", ["link.start_s=1"])) == 1.0


def test_a_flight_at_random_goes_round():
    experiment = load_experiment("fast", [HANDOVER, RANDOM])
    up, down, start_ns = find_ways(experiment)
    assert up.loop
    assert down.loop
    link, _ = build_links(experiment, 5)
    until_ns = 10_000_000_000 - start_ns % 30_000_000_000
    assert link.send(1, 1, 1, 100, 5 + until_ns + 30_000_000_000) == (), "in a blackout"
    assert replace(up, loop=False) == find_ways(load_experiment("fast", [HANDOVER]))[0]


@pytest.mark.parametrize(
    ("setting", "text"),
    [
        ("link.start_s=random", "the schedule has no period; give repeat_s"),
        ("link.start_s=soon", "--set: link.start_s: 'soon': must be 'random'"),
        ("link.start_s=-1", "--set: link.start_s: -1: must be"),
        ("link.uplink.loop=true", "loop: the schedule has no period; give repeat_s"),
    ],
)
def test_what_cannot_be_is_refused(setting, text):
    assert text in refused_line("fast", "link.profile=lte", setting)


def test_a_period_within_the_trace_is_refused_with_its_key(tmp_path):
    (tmp_path / "trace.csv").write_text("time_s,delay_ms\n0,10\n50,20\n")
    trace = f"link.uplink.trace={tmp_path / 'trace.csv'}"
    text = refused_line("fast", trace, "link.uplink.repeat_s=40")
    assert "repeat_s: 40 s ends before the last entry, at 50 s" in text


def test_several_seeds_over_one_line_are_told():
    line, bare = (load_experiment("fast", [f"link.profile={name}"]) for name in ("handover", "lte"))
    text = "20 seeds, one link schedule: --set link.start_s=random"
    assert describe_one_schedule(20, bare, line) == text
    assert describe_one_schedule(20, bare) == describe_one_schedule(1, line) == ""
    drawn = load_experiment("fast", [HANDOVER, RANDOM])
    assert describe_one_schedule(20, drawn) == ""


def test_link_set_begins_a_line_at_its_start():
    edit = edit_profile(Document({}), "handover", ["start_s=12"])
    assert (edit.values["start_s"], edit.restart) == (12.0, True)
    assert edit_profile(Document(edit.values), None, ["link.start_s=random"]).restart
