# SPDX-License-Identifier: Apache-2.0

"""`cloudrc eval --robots N --channel FILE`: several robots share a channel."""

import json

import pytest

from cloudrc.flight.trials.rows import read_rows
from cloudrc.results.timeline.read import read_loops
from cloudrc.studies.eval.episode import play as play_alone
from cloudrc.studies.eval.robots import play
from cloudrc.studies.eval.setup import BASELINE, Episode, EvalSetup, SharedChannel


def setup_of(law, **changed):
    shared = {"robots": 3, "channel": SharedChannel(schedule="largest_age"), "success_at": 100.0}
    return EvalSetup("CartPole-v1", law(), max_steps=120, **{**shared, **changed})


def test_an_episode_of_several_robots_has_their_means_and_each_of_them(law):
    row = play(Episode(0.0, "newest", 2), setup_of(law))
    robots, numbers = row["robots"], row["numbers"]
    assert len(robots) == 3
    assert numbers["return"] == pytest.approx(sum(each["return"] for each in robots) / 3)
    assert numbers["observation_age_max"] == max(each["observation_age_max"] for each in robots)
    assert numbers["observation_age_of"] == sum(each["observation_age_of"] for each in robots)
    assert numbers["success"] == min(each["success"] for each in robots)
    # Steps of 20 ms, a slot of a step: (N + 1) / 2 steps old.
    assert numbers["observation_age"] == pytest.approx(0.04, rel=0.1)
    again = play(Episode(0.0, "newest", 2), setup_of(law))
    assert again["records_sha256"] == row["records_sha256"] != ""


def test_without_a_network_each_robot_is_alone_with_a_seed_of_its_own(law):
    row = play(Episode(None, BASELINE, 2), setup_of(law))
    alone = setup_of(law, robots=1, channel=None)
    seeds = [play_alone(Episode(None, BASELINE, seed), alone) for seed in (4, 5, 6)]
    for robot, each in zip(row["robots"], seeds, strict=True):
        assert robot["return"] == each["numbers"]["return"]
        assert robot["steps"] == each["numbers"]["steps"]


def test_each_robot_keeps_a_timeline_with_its_own_means(law, tmp_path):
    row = play(Episode(0.0, "newest", 2), setup_of(law), keep=tmp_path / "episode.json")
    files = [tmp_path / f"episode-robot{n}.json" for n in range(3)]
    for path, robot in zip(files, row["robots"], strict=True):
        stages = read_loops(path)["episode"].document["stages"]
        assert robot["budget_uplink"] == pytest.approx(stages["uplink"]["mean"], abs=1e-9)
    assert sorted(tmp_path.glob("*.json")) == files


def test_robots_and_channel_are_part_of_what_is_played_and_their_absence_is_not(law, tmp_path):
    alone = setup_of(law, robots=1, channel=None).identity()
    assert not alone.keys() & {"robots", "channel", "schedule"}
    own = tmp_path / "mine.py"
    found = []
    for text in ("def choose(waiting): return 0", "def choose(waiting): return -1 + len(waiting)"):
        own.write_text(text)
        found.append(setup_of(law, channel=SharedChannel(schedule=str(own))).identity())
    assert found[0]["schedule"] != found[1]["schedule"]


def test_the_command_takes_a_file_whose_schedule_lies_beside_it(law, tmp_path, evaluate):
    (tmp_path / "mine.py").write_text("def choose(waiting):\n    return 0\n")
    channel = tmp_path / "channel.yaml"
    channel.write_text("slot_ms: 20\nschedule: ./mine.py\n")
    out = tmp_path / "out"
    words = f"--policy {law()} --seeds 1 --max-steps 60 --success-at 50 --robots 2 --out {out}"
    text = evaluate(*words.split(), "--channel", channel).out
    assert "each of 2 robots" in text
    rows = [*read_rows(out).values()]
    assert [len(row["robots"]) for row in rows] == [2, 2]
    ages = [[robot["observation_age_of"] for robot in row["robots"]] for row in rows]
    assert ages[1][0] > 50
    assert ages[1][1] == 0, "the second one never sends"
    assert json.loads((out / "eval.json").read_text())["identity"]["robots"] == 2


@pytest.mark.parametrize(
    ("words", "text", "said"),
    [
        ("--robots 2", "", "give --robots"),
        ("--channel {}", "slot_ms: 20", "give --robots"),
        ("--robots 2 --channel {}", "slot: 20", "slot_ms"),
        ("--robots 2 --channel {}", "schedule: newest", "round_robin"),
        ("--robots 2 --channel {}", "slot_ms: -1", "slot_ms"),
    ],
)
def test_a_wrong_channel_is_refused_before_a_folder_is_made(
    law, tmp_path, evaluate, words, text, said
):
    channel = tmp_path / "channel.yaml"
    channel.write_text(text)
    out = tmp_path / "out"
    given = f"--policy {law()} --seeds 1 --out {out} {words.format(channel)}"
    assert said in evaluate(*given.split(), code=2).err
    assert not out.exists()
