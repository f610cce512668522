# SPDX-License-Identifier: Apache-2.0

"""Surfaces of robot and scene: closed, turned outwards, and the same after a file."""

import numpy as np
import pytest

from cloudrc.physics.geometry import shapes
from cloudrc.physics.geometry.clearance import rotations
from cloudrc.physics.geometry.shapes import Shapes, Surface

BODIES = {
    "box": (shapes.box((1.0, 2.0, 3.0)), 48.0),
    "cylinder": (shapes.cylinder(1.0, 2.0), 4 * np.pi),
    "sphere": (shapes.globe((1.0, 1.0, 1.0)), 4 / 3 * np.pi),
    "ellipsoid": (shapes.globe((1.0, 2.0, 3.0)), 8 * np.pi),
    "capsule": (shapes.globe((1.0, 1.0, 1.0), 2.0), 4 / 3 * np.pi + 4 * np.pi),
    "terrain": (shapes.terrain(np.full((3, 4), 0.5), 1.0, 2.0, 0.5), 8.0),
}


@pytest.mark.parametrize("name", BODIES)
def test_a_body_has_its_volume_and_triangles_that_look_outwards(name):
    surface, volume = BODIES[name]
    first, second, third = (surface.corners[each] for each in surface.triangles.T)
    normals = np.cross(second - first, third - first)
    bottom = 2.0 if name == "terrain" else 0.0  # it has no face below
    found = np.einsum("ij,ij->i", first, normals).sum() / 6
    assert found == pytest.approx(volume - bottom * 2 / 3 * 0.5 * 2, rel=0.06)
    if surface.convex:
        assert (np.einsum("ij,ij->i", first, normals) > -1e-9).all()
    assert surface.convex == (name != "terrain")


def some():
    robot = Surface("", np.eye(3), np.array([(0, 1, 2)], np.int32), (0.1, 0.2, 0.3, 0.4))
    block = shapes.cylinder(1.0, 2.0).placed(
        (1.0, 2.0, 3.0), rotations(np.array([[0.6, 0.8, 0, 0]]))[0]
    )
    return Shapes((robot,), (Surface("block", block.corners, block.triangles, convex=True),), True)


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
