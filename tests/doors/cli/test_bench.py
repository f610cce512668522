# SPDX-License-Identifier: Apache-2.0

"""The cost of the closed loop."""

import json

import pytest

from tests.support.commands import python


@pytest.mark.process
@pytest.mark.alone  # other processes would take its caches
@pytest.mark.full
def test_the_closed_loop_is_fast_enough_beside_raw_physics():
    done = python("-m", "cloudrc", "bench", "-o", "json", "--repeats", "5")
    assert done.returncode == 0, done.stderr
    figures = json.loads(done.stdout)
    is_fast = figures["physics_steps"].startswith("C (")
    least = (0.50, 0.30) if is_fast else (0.24, 0.18)
    assert figures["closed loop, records in memory"]["ratio"] >= least[0]
    assert figures["flight of a sweep, with its numbers"]["ratio"] >= least[1]
