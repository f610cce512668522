"""What the closed loop costs against physics alone: the promise of the design."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest


@pytest.mark.process  # by itself: what runs beside it takes its caches away
@pytest.mark.full
def test_the_closed_loop_keeps_its_share_of_raw_physics() -> None:
    command = [sys.executable, "-m", "cloudrc", "bench", "-o", "json", "--repeats", "5"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    figures = json.loads(done.stdout)
    assert figures["closed loop, records in memory"]["ratio"] >= 0.30
    assert figures["closed loop, records hashed"]["ratio"] >= 0.25
