# SPDX-License-Identifier: Apache-2.0

"""One error lists all problems of a file, each with its place, its reason and what to do."""

import re
from pathlib import Path

import pytest

from cloudrc.base.errors import BadInputError
from cloudrc.config.profile import load_profile
from tests.config.conftest import refused, refused_line


@pytest.fixture
def mine(tmp_path):
    return tmp_path / "mine.yaml"


def refused_text(path, text):
    path.write_text(text, "utf-8")
    return refused(path).replace(f"{path.parent}/", "")


@pytest.mark.fault(
    37,
    "bad-configuration",
    injects="unknown keys, wrong units, impossible limits",
    expects="refused with the path of each key, its line and the nearest known key",
)
def test_all_problems_are_listed_with_their_lines(mine):
    text = refused_text(
        mine,
        "seed: one\n"
        "guard: {speed_max: 2}\n"
        "link: {profile: paper-p2, uplink: {delay_ms: -3}}\n"
        "world: {scene: pipe}\n",
    )
    first, *rest = text.splitlines()
    assert first == "mine.yaml has 4 problems:"
    assert sorted(line.strip() for line in rest) == sorted([
        "mine.yaml:1: seed: 'one': must be a valid whole number",
        "mine.yaml:2: guard.speed_max: unknown key; did you mean speed_max_mps [m/s]?",
        "mine.yaml:3: link.uplink.delay_ms: -3: must be >= 0 [ms]",
        "mine.yaml:4: world.scene: no scene named 'pipe'; available: corridor, empty, follow, "
        "pillars, pipes; did you mean pipes?; for one of your own, give its path, such as ./pipe",
    ])  # fmt: skip
    text = "cloud:\n  predictor: last_sampel\n  controller: {name: pid, sped_max: 2}\n"
    found = refused_text(mine, text)
    assert "mine.yaml:2: cloud.predictor: no predictor named 'last_sampel'; available: " in found
    assert "mine.yaml:3: cloud.controller.sped_max: unknown key; did you mean speed_max?" in found


def test_fifty_problems_at_most_are_listed(mine):
    points = ", ".join(["{position_m: [0, 0, 1], dwell_s: -1}"] * 60)
    text = refused_text(mine, f"mission: {{waypoints: [{points}]}}\n")
    assert "mine.yaml has 60 problems:" in text
    assert text.endswith("and 10 more")
    assert len(text.splitlines()) == 52


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("seed: 1\nseed: 2", "mine.yaml:2: the key 'seed' is given twice"),
        ("seed: 1\nname: !!python/name:os.system x", "mine.yaml:2: could not determine a constr"),
        ("guard: {speed_max_mps: 7}", "must be at most 6 m/s: above it the robot does not stop"),
        ("mission: {waypoints: []}",
         "mine.yaml:1: mission.waypoints: none given; give waypoints, or steps, or setpoints, "
         "or follow"),
        ("mission: {waypoints: [{tolerance_m: 1}]}",
         "mission.waypoints.0.position_m: is missing"),
        ("mission: {waypoints: [{position_m: [0, 0, 3]}]}",
         "[0, 0, 3]: beyond the fence, or too near to it; the guard keeps the robot within "
         "x -2.8 to 9, y -8.3 to 5.3, z 0.35 to 2.3 [m]"),
        ("mission: {waypoints: [{position_m: [0.5, 0, .7]}, {position_m: [-.6, 0, .8]}]}",
         "waypoints.1.position_m: [-0.6, 0, 0.8]: the robot would be within 0.04 m of the wall of "
         "pipe_1"),
    ],
)  # fmt: skip
def test_an_invalid_file_is_one_line(mine, text, reason):
    mine.write_text(text)
    assert reason in refused_line(mine).replace(f"{mine.parent}/", "")


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("nosuch.yaml", "No such file"),
        ("latin.yaml", "is not UTF-8 text"),
    ],
)
def test_an_unreadable_file_is_reported(tmp_path, monkeypatch, name, reason):
    monkeypatch.chdir(tmp_path)
    Path("latin.yaml").write_bytes(b"description: \xff\xfe")
    assert reason in refused(name)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("mission.waypoints.9.dwell_s=1", "entries 0 to 6; use one of these, or 7 to append"),
        (
            "cloud.plan_s=0.4",
            "cloud.predictor: 'constant_velocity' has no model of the robot, which cloud.plan_s",
        ),
        (
            "world.scene=empty",
            "mission.touch.body: board: no body of the scene empty named 'board'",
        ),
        ("world.robot=./no.xml", "no such folder with robot.yaml or .xml file"),
        # A limit of the guard cannot be switched off.
        ("guard.command_age_max_ms=true", "--set: guard.command_age_max_ms: "),
        ("world.tuning=none", "world.tuning: no tuning of pelican named 'none'; available: fast"),
        ("cloud.send_delta_mps=0.05", "needs plan_s"),
    ],
)
def test_an_invalid_setting_is_refused(text, reason):
    assert reason in refused("paper", *text.split())


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("uplink: {distribution: table}", "uplink: distribution: table needs the key table"),
        ("uplink: {trace: falling.csv}", "falling.csv, line 3"),
    ],
)
def test_an_invalid_profile_is_refused_with_the_reason(mine, text, reason):
    (mine.parent / "falling.csv").write_text("time_s,delay_ms\n1,20\n0,20\n")
    mine.write_text(text)
    with pytest.raises(BadInputError, match=re.escape(reason)):
        load_profile(mine)
    text = refused("paper", f"link.profile={mine}")
    assert reason in text
    assert f"{mine}:1: " in text
