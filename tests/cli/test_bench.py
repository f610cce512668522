"""The bench: the cost of the closed loop and of sealed datagrams."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable

import pytest

from cloudrc.cli.bench import measure_wire


@pytest.mark.process
def test_a_sealed_odometry_costs_an_eighth_of_a_pickled_one(figure: Callable[..., None]) -> None:
    wire = measure_wire()
    figure(
        "seal, open and codec of an odometry over a pickled round trip", wire["ratio"], "<=", 0.12
    )
    assert 1000 <= wire["pickled_size"] <= 1100  # the size in the paper
    assert wire["ratio"] <= 0.12


@pytest.mark.process  # runs alone: other processes would take its caches
@pytest.mark.full
def test_the_closed_loop_is_fast_enough_beside_raw_physics() -> None:
    command = [sys.executable, "-m", "cloudrc", "bench", "-o", "json", "--repeats", "5"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    figures = json.loads(done.stdout)
    assert figures["closed loop, records in memory"]["ratio"] >= 0.30
    assert figures["closed loop, records hashed"]["ratio"] >= 0.25
