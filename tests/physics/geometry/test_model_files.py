# SPDX-License-Identifier: Apache-2.0

"""All files of which a robot or a scene consists are found."""

import pytest

from cloudrc.physics.geometry.model_files import model_files
from cloudrc.physics.sim.engine import mujoco


def place(folder, name, content):
    file = folder / name
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(content)
    return file


def mjcf(inner):
    return f"<mujoco>{inner}</mujoco>"


CORNERS = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


@pytest.mark.parametrize(
    ("compiler", "name", "mesh"),
    [
        ("", "m.obj", "m.obj"),
        ("", "sub/m.obj", "sub/m.obj"),
        ('meshdir="shapes"', "shapes/m.obj", "m.obj"),
    ],
)
def test_a_mesh_is_found_where_mujoco_reads_it(tmp_path, compiler, name, mesh):
    file = place(tmp_path, name, CORNERS)
    asset = f'<compiler {compiler}/><asset><mesh name="m" file="{mesh}"/></asset>'
    scene = place(tmp_path, "scene.xml", mjcf(asset))
    mujoco.MjModel.from_xml_path(str(scene))
    assert model_files(scene) == sorted([scene, file])


def test_nested_includes_and_attached_models_are_found(tmp_path):
    files = [
        place(tmp_path, "parts/one.xml", mjcf('<include file="deep/two.xml"/>')),
        place(tmp_path, "parts/deep/two.xml", mjcf('<asset><mesh name="m" file="m.obj"/></asset>')),
        place(tmp_path, "dirs.xml", mjcf('<compiler meshdir="shapes"/>')),
        place(tmp_path, "shapes/m.obj", CORNERS),
        place(tmp_path, "other.xml", mjcf("")),
        place(tmp_path, "sky/right.png", ""),
    ]
    sky = '<texture name="t" type="cube" fileright="right.png"/>'
    inner = f'<compiler texturedir="sky"/><asset><model name="o" file="other.xml"/>{sky}</asset>'
    includes = '<include file="parts/one.xml"/><include file="dirs.xml"/>'
    scene = place(tmp_path, "scene.xml", mjcf(inner + includes))
    assert model_files(scene) == sorted([scene, *files])
