"""The API under load beside the control loop, which is in another process and must not notice."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from release import TOKEN, Release

from cloudrc.record.reader import read_contents

pytestmark = [pytest.mark.process, pytest.mark.full]

HOVER = """
start: spawn
waypoints:
  - {position_m: [0.5, 0.0, 0.7], tolerance_m: 0.2, dwell_s: 55.0, time_limit_s: 60}
"""
SECONDS, RATE = 20.0, 1000.0
COMMAND = "/cmd_vel"
PERIOD = 0.010


class Recorded(Release):
    """As the release, and cloud is recorded."""

    def run(self, *words):
        words = (*words, "--record", "cloud.mcap") if words[0] == "cloud" else words
        return super().run(*words)


def errors(folder: Path, began_ns: int, ended_ns: int):
    """How far each period of the control loop was from 10 ms [s]."""
    messages = read_contents(folder / "cloud.mcap").messages
    stamps = np.array([stamp for topic, stamp, _ in messages if topic == COMMAND])
    stamps = stamps[(stamps >= began_ns) & (stamps < ended_ns)]
    assert len(stamps) > 0.5 * (ended_ns - began_ns) * 1e-9 / PERIOD
    return np.abs(np.diff(stamps) * 1e-9 - PERIOD)


@pytest.mark.promise("P-API-12")
def test_a_thousand_requests_a_second_do_not_disturb_the_control_loop(tmp_path, figure):
    release = Recorded(tmp_path)
    try:
        (tmp_path / "mission.yaml").write_text(HOVER)
        url = json.loads((tmp_path / "api.json").read_text())["url"]
        release.post_mission()
        release.until(lambda: release.mission()["state"] == "flying")
        time.sleep(2.0)
        calm = time.monotonic_ns()
        time.sleep(SECONDS)
        began = time.monotonic_ns()
        flood = Path(__file__).with_name("api_flood.py")
        command = [sys.executable, str(flood), url, TOKEN, str(SECONDS), str(RATE)]
        flooded = subprocess.run(command, capture_output=True, text=True)
        assert flooded.returncode == 0, flooded.stderr
        ended = time.monotonic_ns()
        release.post("/v1/estop")
        release.until(lambda: release.ask("/v1/state")["seen"]["guard"] == "ESTOP")
        release.stop()
    finally:
        release.end()
    answers = json.loads(flooded.stdout)
    quiet, loud = errors(tmp_path, calm, began), errors(tmp_path, began, ended)
    found = {
        "requests": answers,
        "calm_p99_ms": float(np.percentile(quiet, 99)) * 1e3,
        "flood_p99_ms": float(np.percentile(loud, 99)) * 1e3,
        "processors": os.cpu_count(),
    }
    grown = found["flood_p99_ms"] - found["calm_p99_ms"]
    figure("API flood: requests sent", answers["sent"], ">=", 0.95 * SECONDS * RATE)
    figure("API flood: control period error p99 grows by", grown, "<=", 2.0, "ms")
    assert answers["sent"] >= 0.95 * SECONDS * RATE
    assert answers.get("429", 0) > 0
    assert not [status for status in answers if status.startswith("5")]
    assert grown <= 2.0, found
