# SPDX-License-Identifier: Apache-2.0

"""In real time a slow perception sees fewer scans, and delays no command."""

from pathlib import Path

import numpy as np
import pytest

from cloudrc.results.record.columns import Recording

SLOW = """
import time
from cloudrc.cloud.perceptions.gap import Gap

class Slow(Gap):
    def see(self, seen, odometry):
        end = time.monotonic() + 0.2
        while time.monotonic() < end:  # the thread keeps the processor busy
            sum(range(100))
        return super().see(seen, odometry)

def build():
    return Slow(0.0, 0.4, 2.0, 1.0)
"""


@pytest.mark.process
def test_commands_keep_their_rate_beside_a_perception_of_200_ms(tmp_path, monkeypatch, call):
    monkeypatch.chdir(tmp_path)
    Path("slow.py").write_text(SLOW)
    short = "mission.waypoints=[{position_m: [2, 0], tolerance_m: 0.5}]"
    slow = "cloud.perception=./slow.py"
    call("run gap --mode local --report none --out run --set", short, "--set", slow)
    recording = Recording.read(Path("run/mission.mcap"))
    seen, commands = recording["/perception"], recording["/cmd_vel"]["stamp_ns"]
    assert seen["compute_ns"].min() >= 200_000_000
    assert len(seen) <= len(recording["/scan"]) * 0.6
    assert np.median(np.diff(commands)) == pytest.approx(10_000_000, rel=0.1)
    assert len(commands) > 0.9 * (commands[-1] - commands[0]) * 1e-9 * 100
