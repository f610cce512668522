# SPDX-License-Identifier: Apache-2.0

"""Tubes, plates and floor are read from a scene file; the error names an invalid number."""

import pytest

from cloudrc.base.outside.values import InvalidValueError
from cloudrc.physics.geometry.scene import Plate, load_scene


def test_a_shipped_scene_is_read():
    scene = load_scene("pipes")
    assert [tube.name for tube in scene.tubes] == ["pipe_1", "pipe_2", "pipe_3"]
    board = Plate("board", 8.535, (-6.82, -6.02), (0.025, 1.225))
    assert (scene.plates, scene.floor) == ((board,), 0)
    assert load_scene("empty").bodies == ("floor",)


def scene_file(folder, numbers, world=""):
    path = folder / "mine.xml"
    path.write_text(f"<mujoco><custom>{numbers}</custom><worldbody>{world}</worldbody></mujoco>")
    return str(path)


def test_a_scene_of_ones_own_is_read(tmp_path):
    numbers = (
        '<numeric name="duct" data="0 0 1  0 3 4  2 .5 .6"/>'
        '<numeric name="matrix" data="1 0 0  0 1 0  0 0 1"/>'
        '<numeric name="floor" data="-.1"/><numeric name="other" data="1 2"/>'
    )
    world = '<frame name="spawn" pos="1 2 3"/><body name="hall"><body name="duct"/></body>'
    scene = load_scene(scene_file(tmp_path, numbers, world))
    assert [tube.name for tube in scene.tubes] == ["duct"], "only a shape that a body has"
    assert scene.tubes[0].axis == pytest.approx((0, 0.6, 0.8))
    assert (scene.name, scene.floor, scene.plates) == ("mine", -0.1, ())
    assert scene.spawn == (1, 2, 3)


def test_spawn_and_numbers_of_included_files_count(tmp_path):
    (tmp_path / "parts").mkdir()
    frame = '<mujocoinclude><frame name="spawn" pos="1 2 3"/></mujocoinclude>'
    (tmp_path / "parts" / "spawn.xml").write_text(frame)
    inner = '<mujocoinclude><include file="spawn.xml"/></mujocoinclude>'
    (tmp_path / "parts" / "inner.xml").write_text(inner)
    number = '<custom><numeric name="floor" data="-.1"/></custom>'
    world = '<worldbody><include file="parts/inner.xml"/></worldbody>'
    (tmp_path / "room.xml").write_text(f"<mujoco>{number}{world}</mujoco>")
    (tmp_path / "mine.xml").write_text('<mujoco><include file="room.xml"/></mujoco>')
    scene = load_scene(str(tmp_path / "mine.xml"))
    assert (scene.spawn, scene.floor) == ((1, 2, 3), -0.1)


@pytest.mark.parametrize(
    ("numbers", "reason"),
    [
        ('<numeric name="board" data="1 2 x 4 5"/>', "board: data must be 5 numbers"),
        ('<numeric name="pipe_1" data="0 0 0 1 0 0 5 .7 .6"/>', "0 < inner < outer"),
    ],
)
def test_bad_numbers_are_named(tmp_path, numbers, reason):
    with pytest.raises(InvalidValueError, match=r"scene mine\.xml: .*" + reason):
        load_scene(scene_file(tmp_path, numbers, '<body name="pipe_1"/><body name="board"/>'))
    with pytest.raises(InvalidValueError, match="spawn: data must be 3 numbers: '1 2'"):
        load_scene(scene_file(tmp_path, "", '<frame name="spawn" pos="1 2"/>'))
