# SPDX-License-Identifier: Apache-2.0

"""A fleet in real time: pairs of processes that share a cell, or have links of their own."""

import json
import subprocess
import sys
from shutil import which

import pytest

from cloudrc.results.record.columns import Recording
from tests.conftest import nightly
from tools.bench_cell import measure

pytestmark = [pytest.mark.process, pytest.mark.alone]
FLEET = "mission.steps.count=1 mission.steps.period_s=1 fleet.robots=2".split()
CELL = ["cell.rate_kbit=500"]


@pytest.mark.parametrize("cell", [CELL, *nightly([])])
def test_two_robots_fly_together_and_are_judged_as_a_fleet(tmp_path, cell):
    words = [word for setting in (*FLEET, *cell) for word in ("--set", setting)]
    line = ["-m", "cloudrc", "run", "steps", "--mode", "local", "--report", "none"]
    done = subprocess.run(
        [sys.executable, *line, *words, "--out", "run", "-o", "json"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=180,
    )
    assert done.returncode in (0, 1, 6), done.stderr  # 1, 6: too slow here
    report = json.loads(done.stdout)
    assert report["mode"] == "local"
    assert [way["direction"] for way in report["cell"]] == (["uplink", "downlink"] if cell else [])
    begins = list[int]()
    for number in range(2):
        recording = Recording.read(tmp_path / f"run/robot-{number}/mission.mcap")
        events = recording["/mission"]
        begins.append(int(events["stamp_ns"][events["event"] == "started"][0]))
        assert not (tmp_path / f"run/robot-{number}/link").exists()
    assert abs(begins[0] - begins[1]) < 1_500_000_000
    for way in report["cell"]:
        assert way["packets"] > 300  # of two robots at 100 Hz, in a flight of almost 2 s
        assert not way["dropped"]


@pytest.mark.skipif(not which("cc"), reason="needs a C compiler")
def test_the_cell_loses_nothing_and_sends_nothing_too_early(tmp_path):
    counts, arrived, *_ = measure(3, 1.0, tmp_path)
    assert set(arrived.values()) == {100}
    assert len(arrived) == 6
    assert counts["released_early"] == 0
    assert counts["forwarded"] == 600
