"""Setpoints over time: what is written can be read."""

import pytest

from cloudrc.config.setpoints import read_setpoints, write_setpoints
from tests.fences import FENCE

HERE, THERE = (0.0, 0.0, 1.0), (0.5, 0.0, 1.2)


@pytest.mark.parametrize("gap", [1e-1, 1e-4, 1e-6, 1e-9, 0.0])
def test_setpoints_that_follow_closely_can_be_read_again(gap, tmp_path):
    path = tmp_path / "drive.csv"
    path.write_text(write_setpoints([(0.0, HERE), (70.8107, HERE), (70.8107 + gap, THERE)], FENCE))
    track = read_setpoints(path, FENCE)
    assert track[0] == (0.0, HERE)
    assert track[-1] == (pytest.approx(70.8107 + gap, abs=1e-6), THERE)
