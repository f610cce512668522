"""What the closed loop costs against physics alone: the promise of the design."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable

import pytest

from cloudrc.cli.bench import measure_wire


@pytest.mark.process
def test_a_sealed_odometry_costs_an_eighth_of_the_papers_pickled_one(
    figure: Callable[..., None],
) -> None:
    wire = measure_wire()
    figure("seal, open and codec of an odometry over a pickled round trip", wire.ratio, "<=", 0.12)
    assert 1000 <= wire.pickled_size <= 1100  # as large as the paper's
    assert wire.ratio <= 0.12


@pytest.mark.process  # by itself: what runs beside it takes its caches away
@pytest.mark.full
def test_the_closed_loop_keeps_its_share_of_raw_physics() -> None:
    command = [sys.executable, "-m", "cloudrc", "bench", "-o", "json", "--repeats", "5"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    figures = json.loads(done.stdout)
    assert figures["closed loop, records in memory"]["ratio"] >= 0.30
    assert figures["closed loop, records hashed"]["ratio"] >= 0.25
