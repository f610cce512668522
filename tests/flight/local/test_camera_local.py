# SPDX-License-Identifier: Apache-2.0

"""In real time a camera's pictures are rendered beside the flight, which stays real time."""

import json
from pathlib import Path

import pytest

from cloudrc.config.robot import find_robot
from cloudrc.results.record.columns import Recording
from tests.support.camera import needs_renderer

RATE, DURATION = 10, 15


@needs_renderer
@pytest.mark.process
@pytest.mark.alone
def test_ten_pictures_a_second_leave_real_time_as_it_is(tmp_path, monkeypatch, call):
    monkeypatch.chdir(tmp_path)
    Path("mine").mkdir()
    for file in find_robot("x2").model.parent.glob("robot.*"):
        text = file.read_text().replace("{name: front", f"{{fps: {RATE}, name: front")
        Path("mine", file.name).write_text(text)
    short = f"mission.follow.duration_s={DURATION}"
    line = "run follow --mode local --report none --out run --set world.robot=./mine --set"
    call(line, short)
    numbers = json.loads(Path("run/report.json").read_text())["numbers"]
    assert numbers["real_time_factor"]["value"] >= 0.99
    recording = Recording.read(Path("run/mission.mcap"))
    taken, late = recording["/frame"]["taken_ns"], numbers["frames_late"]["value"]
    due = (taken[-1] - taken[0]) * 1e-9 * RATE + 1
    assert len(taken) + late == pytest.approx(due, abs=3), "each is taken, or counted as late"
    assert numbers["frames_shown"]["value"] > 0.95
