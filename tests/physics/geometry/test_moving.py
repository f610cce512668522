# SPDX-License-Identifier: Apache-2.0

"""A body of a scene moves along its path as a function of time."""

import pytest

from cloudrc.base.outside.values import InvalidValueError
from cloudrc.config.shipped import file_of
from cloudrc.physics.geometry.moving import Moving
from cloudrc.physics.geometry.scene import load_scene

CORNERS = ((0.0, 0.0, 1.0), (3.0, 0.0, 1.0), (3.0, 4.0, 1.0))


@pytest.mark.parametrize(
    ("time", "place"),
    [
        (-1.0, (0.0, 0.0, 1.0)),
        (0.0, (0.0, 0.0, 1.0)),
        (1.0, (2.0, 0.0, 1.0)),
        (2.5, (3.0, 2.0, 1.0)),
        (4.75, (1.5, 2.0, 1.0)),  # back to the first point, which is 5 m away
        (6.0, (0.0, 0.0, 1.0)),
        (61.0, (2.0, 0.0, 1.0)),
    ],
)
def test_it_goes_round_and_round_at_its_speed(time, place):
    assert Moving("board", CORNERS, 2.0).at(time) == pytest.approx(place)


def test_a_scene_tells_what_moves():
    (board,) = load_scene("follow").moving
    assert (board.name, board.path[0]) == ("board", (3.0, 0.0, 1.5))
    assert load_scene("pipes").moving == ()


@pytest.mark.parametrize(
    ("before", "after", "reason"),
    [
        (' mocap="true"', "", 'board: has the numbers board_path, so it needs mocap="true"'),
        ("3 0 1.5  3 3 1.8", "3 0 1.5  3 3", "board_path: data must be"),
        ('pos="3 0 1.5"', 'pos="3 0 1"', "board: its pos must be the first point"),
        ('name="board_speed"', 'name="speed"', "board_speed: data must be 1 numbers"),
        ('board_speed" data="1"', 'board_speed" data="0"', "board_speed: .* a speed above 0"),
    ],
)
def test_a_path_that_cannot_be_flown_is_refused(tmp_path, before, after, reason):
    text = file_of("follow").read_text()
    assert before in text
    path = tmp_path / "mine.xml"
    path.write_text(text.replace(before, after))
    with pytest.raises(InvalidValueError, match=reason):
        load_scene(str(path))
