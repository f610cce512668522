# SPDX-License-Identifier: Apache-2.0

"""`cloudrc capacity` finds the capacity, and goes on where it ended."""

import json

import pytest

from tests.doors.cli.conftest import SHORT

LINE = "capacity", "steps", *SHORT, "--cell", "300", "--seeds", "1", "--max", "2", "--out", "out"


@pytest.mark.full
def test_the_capacity_of_a_small_cell(folder, call):
    first = call(*LINE, "--queue", "fifo:20", "-o", "json")
    (found,) = json.loads(first.out)["conditions"]
    assert (found["capacity"], found["queue"]) == (1, "fifo 20")
    assert [each["success"] for each in found["fleets"]] == [1, 0]
    assert "command_age" in found["limits"]
    assert (folder / "out/capacity.png").exists()
    again = call(*LINE, "--queue", "fifo:20")
    assert "seed 1: " in first.err
    assert "seed 1: " not in again.err
    assert "capacity, fifo 20, pid: 1 robots [1, 1] (range over 1 seeds)" in again.out


def test_robots_that_share_nothing_have_no_capacity(refused):
    assert "--cell: the robots share nothing" in refused("capacity steps")
