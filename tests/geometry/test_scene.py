"""The numbers in a scene file are those of the plant; bad ones are named."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from cloudrc.errors import BadInputError
from cloudrc.geometry import fence
from cloudrc.geometry.scene import Board, Scene, load_scene, read_scene


def test_pipes_are_those_of_the_plant() -> None:
    scene = load_scene("pipes")
    assert [pipe.name for pipe in scene.pipes] == ["pipe_1", "pipe_2", "pipe_3"]
    ends = [
        [tuple(c + sign * 2.5 * a for c, a in zip(pipe.centre, pipe.axis, strict=True)) for sign in
         (-1, 1)]
        for pipe in scene.pipes
    ]  # fmt: skip
    # Source: docs/reference/plant.md, "Scene".
    expected = [
        [(-1, 2.5, 0.8), (-1, -2.5, 0.8)],
        [(-0.8334, -2.8682, 0.8), (2.7534, -6.3518, 0.8)],
        [(3.160, -6.418, 0.8), (8.160, -6.422, 0.8)],
    ]
    for pipe, found, wanted in zip(scene.pipes, ends, expected, strict=True):
        assert (pipe.length, pipe.inner, pipe.outer) == (5.0, 0.662, 0.700)
        assert math.hypot(*pipe.axis) == pytest.approx(1, abs=1e-12)
        for one, other in zip(found, wanted, strict=True):
            assert one == pytest.approx(other, abs=5e-4)
    assert scene.board == Board(8.535, (-6.82, -6.02), (0.025, 1.225))
    assert scene.floor == 0


def test_the_empty_scene_has_no_obstacles() -> None:
    assert load_scene("empty") == Scene("empty")


def scene_file(folder: Path, body: str) -> Path:
    path = folder / "mine.xml"
    path.write_text(f"<mujoco><custom>{body}</custom></mujoco>")
    return path


def test_only_the_axis_is_normalised(tmp_path: Path) -> None:
    scene = read_scene(
        scene_file(
            tmp_path,
            '<numeric name="pipe_a" data="0 0 1  0 3 4  2 .5 .6"/>'
            '<numeric name="floor" data="-.1"/><numeric name="other" data="1 2"/>',
        )
    )
    assert scene.pipes[0].axis == pytest.approx((0, 0.6, 0.8))
    assert (scene.name, scene.floor, scene.board) == ("mine", -0.1, None)


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        ('<numeric name="pipe_1" data="1 2 3"/>', "pipe_1: data must be 9 numbers"),
        ('<numeric name="pipe_1" data="0 0 0 0 0 0 5 .6 .7"/>', "pipe_1: needs an axis"),
        ('<numeric name="pipe_1" data="0 0 0 1 0 0 5 .7 .6"/>', "0 < inner < outer"),
        ('<numeric name="board" data="1 2 x 4 5"/>', "board: data must be 5 numbers"),
        ('<numeric name="floor" data="nan"/>', "floor: data must be 1 numbers"),
        ("<numeric", "not readable as XML"),
    ],
)
def test_bad_numbers_are_named(tmp_path: Path, body: str, reason: str) -> None:
    with pytest.raises(BadInputError, match=r"scene mine\.xml: .*" + reason):
        read_scene(scene_file(tmp_path, body))


def test_a_missing_scene_is_refused() -> None:
    with pytest.raises(BadInputError, match="No such file"):
        load_scene("nowhere")


def test_the_fence_is_a_closed_box() -> None:
    assert fence.inside((9.2, 5.5, 2.5))
    assert fence.inside((-3, -8.5, 0))
    assert not fence.inside((0, 0, -1e-9))
    assert fence.clamp((20, -20, 1)) == (9.2, -8.5, 1)
    assert fence.clamp((1, 2, 1.5)) == (1, 2, 1.5)
