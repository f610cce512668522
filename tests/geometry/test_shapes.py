"""Surfaces of robot and scene: closed, turned outwards, and the same after a file."""

import numpy as np
import pytest

from cloudrc.errors import BadInputError
from cloudrc.geometry import shapes
from cloudrc.geometry.scene import Tube
from cloudrc.geometry.shapes import Shapes, Surface
from cloudrc.geometry.tubes import rims, wall

BODIES = {
    "box": (shapes.box((1.0, 2.0, 3.0)), 48.0),
    "cylinder": (shapes.cylinder(1.0, 2.0), 4 * np.pi),
    "sphere": (shapes.globe((1.0, 1.0, 1.0)), 4 / 3 * np.pi),
    "ellipsoid": (shapes.globe((1.0, 2.0, 3.0)), 8 * np.pi),
    "capsule": (shapes.globe((1.0, 1.0, 1.0), 2.0), 4 / 3 * np.pi + 4 * np.pi),
    "terrain": (shapes.terrain(np.full((3, 4), 0.5), 1.0, 2.0, 0.5), 8.0),
}


@pytest.mark.parametrize("name", BODIES)
def test_a_body_is_closed_and_has_its_volume_and_faces_that_look_outwards(name):
    surface, volume = BODIES[name]
    triangles = surface.corners[surface.triangles]
    found = np.einsum("ij,ij->i", triangles[:, 0], np.cross(triangles[:, 1], triangles[:, 2]))
    bottom = 2.0 if name == "terrain" else 0.0  # it has no face below
    assert found.sum() / 6 == pytest.approx(volume - bottom * 2 / 3 * 0.5 * 2, rel=0.06)
    if name == "terrain":
        return
    places, rows = np.unique(np.round(surface.corners, 9), axis=0, return_inverse=True)
    turned = rows.reshape(-1)[surface.triangles]
    edges = np.concatenate([turned[:, [0, 1]], turned[:, [1, 2]], turned[:, [2, 0]]])
    assert len(np.unique(edges, axis=0)) == len(edges), "each way along an edge once"
    assert {tuple(edge) for edge in edges.tolist()} == {(b, a) for a, b in edges.tolist()}
    assert surface.convex
    assert len(places)


def some():
    robot = Surface("", np.eye(3), (np.array([(0, 1, 2)], np.int32),), (0.1, 0.2, 0.3, 0.4))
    block = shapes.cylinder(1.0, 2.0).placed((1.0, 2.0, 3.0), shapes.rotation((0.6, 0.8, 0, 0)))
    return Shapes((robot,), (Surface("block", block.corners, block.faces, convex=True),), True)


def test_a_file_has_the_same_shapes_and_is_the_same_each_time():
    data = some().to_bytes()
    read = Shapes.from_bytes(data)
    assert read.to_bytes() == some().to_bytes() == data
    assert (read.planar, read.robot[0].body, read.scene[0].body) == (True, "", "block")
    assert read.robot[0].rgba == pytest.approx((0.1, 0.2, 0.3, 0.4))
    np.testing.assert_allclose(read.scene[0].corners, some().scene[0].corners, atol=1e-6)
    np.testing.assert_array_equal(read.scene[0].triangles, some().scene[0].triangles)
    empty = Shapes.from_bytes(Shapes().to_bytes())
    assert (empty.robot, empty.scene, empty.size) == ((), (), 0.0)


def test_a_damaged_file_is_refused_and_nothing_else_is_raised():
    data = some().to_bytes()
    broken = [b"", b"PK", data[: len(data) // 2]]
    broken += [data[:place] + bytes(9) + data[place + 9 :] for place in range(0, len(data), 50)]
    refused = 0
    for each in broken:
        try:
            Shapes.from_bytes(each)
        except BadInputError:
            refused += 1
    assert refused > 3


def test_a_face_without_corner_is_refused():
    robot = Surface("", np.eye(3), (np.array([(0, 1, 3)], np.int32),))
    with pytest.raises(BadInputError, match=r"shapes\.npz"):
        Shapes.from_bytes(Shapes((robot,)).to_bytes())


@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.6, 0.0, 0.8)])
def test_wall_and_rims_lie_on_the_faces_of_their_tube(axis):
    tube = Tube("tube", (1.0, 2.0, 3.0), axis, 5.0, 0.6, 0.7)
    colour = (1.0, 1.0, 1.0, 1.0)
    for surface in (wall(tube, colour), *rims(tube, colour)):
        relative = surface.corners - tube.centre
        along = relative @ np.array(axis)
        assert np.abs(along) == pytest.approx(2.5)
        radii = np.linalg.norm(relative - along[:, None] * axis, axis=1)
        assert set(np.round(radii, 6)) <= {0.6, 0.7}
