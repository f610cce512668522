"""The numbers in a scene file are those of the plant; bad ones are named."""

import math

import pytest

from cloudrc.errors import BadInputError
from cloudrc.geometry.scene import Board, Scene, load_scene


def test_pipes_are_those_of_the_plant():
    """Source: docs/reference/plant.md, "Scene"."""
    scene = load_scene("pipes")
    begins = {
        "pipe_1": (-1, 2.5, 0.8),
        "pipe_2": (-0.8334, -2.8682, 0.8),
        "pipe_3": (3.160, -6.418, 0.8),
    }
    assert [pipe.name for pipe in scene.pipes] == list(begins)
    for pipe in scene.pipes:
        assert (pipe.length, pipe.inner, pipe.outer) == (5.0, 0.662, 0.700)
        assert math.hypot(*pipe.axis) == pytest.approx(1, abs=1e-12)
        begin = [c - 2.5 * a for c, a in zip(pipe.centre, pipe.axis, strict=True)]
        assert begin == pytest.approx(begins[pipe.name], abs=5e-4)
    assert (scene.board, scene.floor) == (Board(8.535, (-6.82, -6.02), (0.025, 1.225)), 0)
    assert load_scene("empty") == Scene("empty")


def scene_file(folder, numbers, world=""):
    path = folder / "mine.xml"
    path.write_text(f"<mujoco><custom>{numbers}</custom><worldbody>{world}</worldbody></mujoco>")
    return str(path)


def test_a_scene_of_ones_own_is_read(tmp_path):
    numbers = (
        '<numeric name="pipe_a" data="0 0 1  0 3 4  2 .5 .6"/>'
        '<numeric name="floor" data="-.1"/><numeric name="other" data="1 2"/>'
    )
    scene = load_scene(scene_file(tmp_path, numbers, '<frame name="spawn" pos="1 2 3"/>'))
    assert scene.pipes[0].axis == pytest.approx((0, 0.6, 0.8))
    assert (scene.name, scene.floor, scene.board) == ("mine", -0.1, None)
    assert scene.spawn == (1, 2, 3)


@pytest.mark.parametrize(
    ("numbers", "reason"),
    [
        ('<numeric name="board" data="1 2 x 4 5"/>', "board: data must be 5 numbers"),
        ('<numeric name="pipe_1" data="0 0 0 1 0 0 5 .7 .6"/>', "0 < inner < outer"),
        ('<numeric name="floor" data="nan"/>', "floor: data must be 1 numbers"),
        ("<numeric", "not readable as XML"),
    ],
)
def test_bad_numbers_are_named(tmp_path, numbers, reason):
    with pytest.raises(BadInputError, match=r"scene mine\.xml: .*" + reason):
        load_scene(scene_file(tmp_path, numbers))


def test_a_bad_spawn_and_a_missing_scene_are_refused(tmp_path):
    with pytest.raises(BadInputError, match="spawn: data must be 3 numbers: '1 2'"):
        load_scene(scene_file(tmp_path, "", '<frame name="spawn" pos="1 2"/>'))
    with pytest.raises(BadInputError, match="No such file"):
        load_scene("nowhere")
