# SPDX-License-Identifier: Apache-2.0

"""The solids of a user's scene are where MuJoCo has its geoms."""

import numpy as np
import pytest

from cloudrc.physics.geometry import solids
from cloudrc.physics.geometry.scene import load_scene
from cloudrc.physics.geometry.solids import Solid
from cloudrc.physics.sim.bodies import complete
from cloudrc.physics.sim.engine import mujoco

GEOMS = {
    "box": '<geom type="box" size=".2 .3 .4"/>',
    "sphere": '<geom size=".3"/>',
    "capsule": '<geom type="capsule" size=".1 .4"/>',
    "cylinder": '<geom type="cylinder" size=".2 .4"/>',
    "plane": '<geom type="plane" size="0 0 1"/>',
    "hull": '<geom type="mesh" mesh="m"/>',
}
MESH = '<asset><mesh name="m" vertex="-.2 -.2 0 .3 -.2 0 0 .4 0 0 0 .5 .1 .1 .1"/></asset>'
PLACE = 'pos="1 2 1.5" euler="20 30 40"'
CUBE = " ".join(f"{x} {y} {z}" for x in (-0.2, 0.2) for y in (-0.3, 0.3) for z in (-0.4, 0.4))


@pytest.fixture
def read(scene_with):
    """Return a function that writes a scene with some bodies and assets, and reads its bodies."""
    return lambda bodies, more="": complete(load_scene(scene_with(bodies, MESH + more)))


def true_distances(geom, points):
    """Let MuJoCo compute the distances of points from a geom [m]."""
    ball = '<body name="ball" mocap="true"><geom name="ball" size=".001"/></body>'
    body = f"<body {PLACE}>{geom}</body>".replace("<geom", '<geom name="it"')
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco>{MESH}<worldbody>{body}{ball}</worldbody></mujoco>"
    )
    data, ids = mujoco.MjData(model), [model.geom(name).id for name in ("it", "ball")]
    found = []
    for point in points:
        data.mocap_pos[0] = point
        mujoco.mj_forward(model, data)
        found.append(mujoco.mj_geomDistance(model, data, *ids, 10.0, None) + 0.001)
    return np.array(found)


@pytest.mark.parametrize("shape", GEOMS)
def test_a_solid_is_as_far_away_as_its_geom(shape, read):
    (solid,) = read(f'<body name="it" {PLACE}>{GEOMS[shape]}</body>').solids
    assert (solid.name, solid.shape) == ("it", shape)
    points = np.random.default_rng(1).uniform((0, 1, 0.5), (2, 3, 2.5), (200, 3))
    found, true = solid.distance(points), true_distances(GEOMS[shape], points)
    outside = true > 0.01
    assert outside.sum() > 50
    assert found[outside] == pytest.approx(true[outside], abs=2e-3)
    assert (found[true < -0.01] < 0).all()


def near(size):
    """Return points inside and outside of a body with half the edges `size` about the origin."""
    points = np.random.default_rng(2).uniform(-2, 2, (2000, 3)) * size
    return np.concatenate((points, np.zeros((1, 3)), np.diag(size), 0.5 * np.diag(size)))


def test_a_box_of_a_mesh_is_as_far_away_as_a_box(read, monkeypatch):
    monkeypatch.setattr(solids, "_CELLS_MAX", 1000)  # many parts
    geom = '<geom type="mesh" mesh="cube" euler="0 0 45"/>'
    cube = f'<asset><mesh name="cube" vertex="{CUBE}"/></asset>'
    (mesh,) = read(f'<body name="it" pos="1 2 3">{geom}</body>', cube).solids
    size = np.array((0.2, 0.3, 0.4))
    box, points = Solid("it", "box", np.zeros(3), np.eye(3), size, None), near(size)
    turned = np.array(((1, -1, 0), (1, 1, 0), (0, 0, 2**0.5))) / 2**0.5
    found = mesh.distance(points @ turned.T + (1, 2, 3))
    assert found == pytest.approx(box.distance(points), abs=3e-5)
    assert mesh.distance(np.ones((4, 2, 3))).shape == (4, 2)


def test_only_what_the_robot_can_touch_is_a_solid(read):
    bodies = read(
        '<body name="ghost"><geom size=".1" contype="0" conaffinity="0"/></body>'
        '<body name="other"><geom size=".1" contype="2" conaffinity="4"/></body>'
        '<body name="half"><geom size=".1" contype="2" conaffinity="1"/></body>'
        '<body name="hills"><geom type="hfield" hfield="h"/></body>',
        '<asset><hfield name="h" nrow="2" ncol="2" size="1 1 .5 .1" elevation="0 0 1 1"/></asset>',
    )
    assert bodies.bodies == ("floor", "ghost", "other", "half", "hills")
    assert [(solid.name, solid.shape) for solid in bodies.solids] == [
        ("half", "sphere"),
        ("hills", "outline"),
    ]
