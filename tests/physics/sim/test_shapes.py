# SPDX-License-Identifier: Apache-2.0

"""Shapes come from the compiled model, for every type of geom, with its colour."""

import numpy as np
import pytest

from cloudrc.config.world import ResolvedWorld
from cloudrc.physics.geometry.shapes import Shapes
from cloudrc.physics.sim.engine import mujoco
from cloudrc.results.report.shapes import read_shapes

SCENE = """<mujoco>
  <option timestep=".002"/>
  <asset>
    <material name="green" rgba="0 1 0 .5"/>
    <texture name="plain" type="2d" builtin="flat" rgb1=".2 .4 .8" width="8" height="8"/>
    <material name="printed" texture="plain"/>
    <mesh name="wedge" vertex="0 0 0  1 0 0  0 1 0  0 0 1  1 0 1"/>
    <hfield name="hill" nrow="2" ncol="3" size="1 1 .5 .1" elevation="0 1 0 0 1 0"/>
  </asset>
  <worldbody>
    <frame name="spawn" pos="1 2 .5" euler="0 0 90"/>
    <body name="floor"><geom type="plane" size="9 9 1"/></body>
    <body name="box" pos="3 0 1"><geom type="box" size=".1 .2 .3" euler="30 0 9" rgba="1 0 0 1"/>
    </body>
    <body name="ball" pos="4 0 1"><geom type="sphere" size=".3" material="green"/></body>
    <body name="rod" pos="5 0 1"><geom type="capsule" size=".1 .5" euler="0 60 0"/></body>
    <body name="can" pos="6 0 1"><geom type="cylinder" size=".2 .5" euler="0 60 0"
      material="printed"/></body>
    <body name="egg" pos="7 0 1"><geom type="ellipsoid" size=".2 .3 .5" euler="10 20 30"/></body>
    <body name="wedge" pos="8 0 1"><geom type="mesh" mesh="wedge" euler="10 20 30"/></body>
    <body name="hill" pos="9 0 0"><geom type="hfield" hfield="hill"/></body>
    <body name="wall" pos="0 5 0"><geom type="plane" size="2 1 1" euler="90 0 0"/></body>
    <body name="twin" pos="0 0 3">
      <geom type="box" size=".1 .1 .1" group="2"/><geom type="box" size=".5 .5 .5" group="3"/>
    </body>
    <body name="coarse" pos="0 0 4"><geom type="box" size=".2 .2 .2" group="3"/></body>
    <body name="unseen" pos="0 0 5"><geom type="box" size=".2 .2 .2" rgba="1 1 1 0"/></body>
  </worldbody>
</mujoco>"""


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "scene.xml"
    path.write_text(SCENE)
    return path


def test_every_type_of_geom_has_its_place_size_and_colour(scene):
    found = {
        each.body: each
        for each in read_shapes(ResolvedWorld(robot="rover", scene=str(scene))).scene
    }
    seen = {"box", "ball", "rod", "can", "egg", "wedge", "hill", "wall", "twin", "coarse"}
    assert found.keys() == seen, "the floor is a grid; a geom without opacity is not drawn"
    model = mujoco.MjModel.from_xml_string(SCENE)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    for geom in range(model.ngeom):
        body = model.body(model.geom_bodyid[geom]).name
        if body in seen - {"twin", "wall"}:
            axes, points = data.geom_xmat[geom].reshape(3, 3), found[body].corners
            middle, half = model.geom_aabb[geom].reshape(2, 3)
            local = (points - data.geom_xpos[geom]) @ axes - middle
            np.testing.assert_allclose(local.max(axis=0), half, atol=0.02)
            np.testing.assert_allclose(local.min(axis=0), -half, atol=0.02)
    assert found["box"].rgba == (1.0, 0.0, 0.0, 1.0)
    assert found["ball"].rgba == (0.0, 1.0, 0.0, 0.5)
    assert found["can"].rgba == pytest.approx((0.2, 0.4, 0.8, 1.0), abs=0.01)
    assert np.ptp(found["twin"].corners, axis=0).max() == pytest.approx(0.2)
    assert np.ptp(found["wall"].corners, axis=0) == pytest.approx((4.0, 0.0, 2.0))


@pytest.mark.parametrize("robot", ["pelican", "x2", "nano", "rover"])
def test_the_robot_is_in_the_frame_of_its_base(scene, robot):
    turned = read_shapes(ResolvedWorld(robot=robot, scene=str(scene)))
    level = read_shapes(ResolvedWorld(robot=robot, scene="empty"))
    assert turned.planar == (robot == "rover")
    for one, other in zip(turned.robot, level.robot, strict=True):
        assert one.rgba == other.rgba
        np.testing.assert_allclose(one.corners, other.corners, atol=1e-9)


def test_the_camera_of_a_robot_looks_along_z_of_its_frame():
    """x of the frame is to the right, y down, as REP-103 says of optical frames."""
    shapes = read_shapes(ResolvedWorld(robot="x2", scene="empty"))
    place, turn = Shapes.from_bytes(shapes.to_bytes()).camera
    assert place == pytest.approx((0.1, 0.0, 0.0))
    assert abs(np.dot(turn, (0.5, -0.5, 0.5, -0.5))) == pytest.approx(1.0)
    assert read_shapes(ResolvedWorld(robot="pelican", scene="empty")).camera is None
