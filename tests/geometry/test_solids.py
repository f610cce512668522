"""The solids of a user's scene are where MuJoCo has its geoms."""

import numpy as np
import pytest

from cloudrc.errors import BadInputError
from cloudrc.geometry.compiled import mujoco, read_bodies
from cloudrc.geometry.scene import SCENES

GEOMS = {
    "box": '<geom type="box" size=".2 .3 .4"/>',
    "sphere": '<geom size=".3"/>',
    "capsule": '<geom type="capsule" size=".1 .4"/>',
    "cylinder": '<geom type="cylinder" size=".2 .4"/>',
    "ellipsoid": '<geom type="ellipsoid" size=".2 .3 .4"/>',
    "plane": '<geom type="plane" size="0 0 1"/>',
    "hull": '<geom type="mesh" mesh="m"/>',
}
MESH = '<asset><mesh name="m" vertex="-.2 -.2 0 .3 -.2 0 0 .4 0 0 0 .5 .1 .1 .1"/></asset>'
PLACE = 'pos="1 2 1.5" euler="20 30 40"'
EXACT = {"box", "sphere", "capsule", "cylinder", "plane"}


def scene(folder, bodies, more=""):
    text = (SCENES / "empty.xml").read_text().replace("<worldbody>", f"{MESH}<worldbody>")
    path = folder / "mine.xml"
    path.write_text(text.replace("</worldbody>", f"{bodies}</worldbody>{more}"))
    return path


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
def test_a_solid_is_as_far_away_as_its_geom(shape, tmp_path):
    (solid,) = read_bodies(scene(tmp_path, f'<body name="it" {PLACE}>{GEOMS[shape]}</body>')).solids
    assert (solid.name, solid.shape) == ("it", shape)
    points = np.random.default_rng(1).uniform((0, 1, 0.5), (2, 3, 2.5), (200, 3))
    found, true = solid.distance(points), true_distances(GEOMS[shape], points)
    outside = true > 0.01
    assert outside.sum() > 50
    assert (found <= true + 2e-3)[outside].all()
    if shape in EXACT:
        assert found[outside] == pytest.approx(true[outside], abs=2e-3)
    if shape != "plane":
        centres = np.linalg.norm(points - solid.centre, axis=1)
        assert (true >= centres - solid.radius - 2e-3)[outside].all()
    assert (found[true < -0.01] < 0).all()


def test_only_what_the_robot_can_touch_is_a_solid(tmp_path):
    path = scene(
        tmp_path,
        '<body name="ghost"><geom size=".1" contype="0" conaffinity="0"/></body>'
        '<body name="other"><geom size=".1" contype="2" conaffinity="4"/></body>'
        '<body name="half"><geom size=".1" contype="2" conaffinity="1"/></body>'
        '<body name="hills"><geom type="hfield" hfield="h"/></body>',
        '<asset><hfield name="h" nrow="2" ncol="2" size="1 1 .5 .1" elevation="0 0 1 1"/></asset>',
    )
    bodies = read_bodies(path)
    assert bodies.names == ("floor", "ghost", "other", "half", "hills")
    assert [(solid.name, solid.shape) for solid in bodies.solids] == [
        ("half", "sphere"),
        ("hills", "outline"),
    ]


def test_a_changed_file_is_read_again(tmp_path):
    path = scene(tmp_path, '<body name="a"><geom size=".1"/></body>')
    assert read_bodies(path).names == ("floor", "a")
    scene(tmp_path, '<body name="another"><geom size=".1"/></body>')
    assert read_bodies(path).names == ("floor", "another")
    path.unlink()
    with pytest.raises(BadInputError, match=r"mine\.xml: cannot be read"):
        read_bodies(path)


def test_a_changed_include_is_read_again(tmp_path):
    path = scene(tmp_path, '<include file="part.xml"/>')
    for name in ("a", "another"):
        body = f'<body name="{name}"><geom size=".1"/></body>'
        (tmp_path / "part.xml").write_text(f"<mujoco>{body}</mujoco>")
        assert read_bodies(path).names == ("floor", name)
