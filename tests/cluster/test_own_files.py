# SPDX-License-Identifier: Apache-2.0

"""The user's robot and scene reach the pods as ConfigMaps, or one line says why they cannot."""

import shutil

import pytest

from cloudrc.base.errors import BadInputError
from cloudrc.cluster.own_files import find_own_files, send_own_files
from cloudrc.config.shipped import FOLDERS
from cloudrc.config.world import ResolvedWorld

MESHES = """<mujoco><compiler meshdir="meshes"/><asset><mesh name="arm" file="arm.stl"/></asset>
<worldbody/></mujoco>"""
BESIDE = MESHES.replace(' meshdir="meshes"', "")


@pytest.fixture
def robot(tmp_path):
    """A copy of the rover, with what a folder has besides: tests, a picture, hidden folders."""
    folder = tmp_path / "my_robot"
    shutil.copytree(FOLDERS["robot"] / "rover", folder)
    for name in ("tests", "__pycache__", ".git"):
        (folder / name).mkdir()
    (folder / "tests" / "test_it.py").write_text("")
    return folder


def find(robot):
    return find_own_files(ResolvedWorld(robot=str(robot), scene="pillars"))


def refused(robot):
    with pytest.raises(BadInputError) as error:
        find(robot)
    assert "\n" not in str(error.value)
    return str(error.value)


def test_files_in_the_robots_folder_are_found_and_unneeded_folders_left_out(robot):
    assert find_own_files(ResolvedWorld(robot="rover", scene="pillars")) == {}
    assert sorted(find(robot)["robot"]) == ["robot.xml", "robot.yaml"]


def test_a_missing_namespace_is_made_for_the_files(robot, api, release):
    del api.objects["namespaces", "demo"]
    send_own_files(release, find(robot))
    assert ("namespaces", "demo") in api.objects


def test_a_mesh_beside_the_model_is_sent_and_one_in_a_folder_refused(robot):
    (robot / "robot.xml").write_text(BESIDE)
    (robot / "arm.stl").write_bytes(b"solid")
    assert "arm.stl" in find(robot)["robot"]
    (robot / "robot.xml").write_text(MESHES)
    (robot / "meshes").mkdir()
    shutil.move(robot / "arm.stl", robot / "meshes")
    said = refused(robot)
    assert f"{robot}/meshes/arm.stl" in said
    assert "no folders" in said


def test_a_robot_without_a_size_is_refused_with_the_line_to_add(robot):
    file = robot / "robot.yaml"
    text = file.read_text()
    (size,) = (line for line in text.splitlines() if line.startswith("hull_m"))
    file.write_text(text.replace(size, ""))
    said = refused(robot)
    assert str(file) in said
    file.write_text(text.replace(size, said.rpartition("add the line ")[2]))
    assert "robot" in find(robot)


def test_a_scene_is_sent_under_a_fixed_name_with_the_files_that_it_names(tmp_path):
    (tmp_path / "lab.xml").write_text(BESIDE)
    (tmp_path / "arm.stl").write_bytes(b"solid")
    (tmp_path / "other.xml").write_text("<mujoco/>")
    found = find_own_files(ResolvedWorld(scene=str(tmp_path / "lab.xml")))
    assert {name: path.name for name, path in found["scene"].items()} == {
        "scene.xml": "lab.xml",
        "arm.stl": "arm.stl",
    }
