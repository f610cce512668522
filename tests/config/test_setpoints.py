# SPDX-License-Identifier: Apache-2.0

"""Setpoints over time: what is written can be read."""

import pytest

from cloudrc.base.errors import BadInputError
from cloudrc.config.setpoints import read_setpoints, write_setpoints
from tests.fences import FENCE

HERE, THERE = (0.0, 0.0, 1.0), (0.5, 0.0, 1.2)


@pytest.mark.parametrize("gap", [1e-4, 1e-9, 0.0])
def test_setpoints_that_follow_closely_can_be_read_again(gap, tmp_path):
    path = tmp_path / "drive.csv"
    path.write_text(write_setpoints([(0.0, HERE), (70.8107, HERE), (70.8107 + gap, THERE)], FENCE))
    track = read_setpoints(path, FENCE)
    assert track[0] == (0.0, HERE)
    assert track[-1] == (pytest.approx(70.8107 + gap, abs=1e-6), THERE)


HEAD = "time_s,x_m,y_m,z_m"


@pytest.mark.parametrize("row", ["0.5,0,0,1", "3,0,0", "3,nan,0,1"])
def test_the_wrong_row_of_setpoints_is_named_by_its_line(tmp_path, row):
    path = tmp_path / "drive.csv"
    path.write_text(f"{HEAD}\n0,0,0,1\n1,0,0,1\n{row}\n4,0,0,1\n")
    with pytest.raises(BadInputError, match=r"drive\.csv, line 4: "):
        read_setpoints(path, FENCE)


def test_setpoints_are_read_in_the_units_of_their_head(tmp_path):
    path = tmp_path / "drive.csv"
    path.write_text("z_m;time_ms;x_m;y_m\n1;7000;0;0\n1.2;8500;0.5;0\n")
    assert read_setpoints(path, FENCE) == ((0.0, HERE), (1.5, THERE))
    path.write_text("time_s,x_mm,y_m,z_m\n0,0,0,1\n")
    with pytest.raises(BadInputError, match="no column x_m; it has time_s, x_mm"):
        read_setpoints(path, FENCE)
