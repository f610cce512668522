# SPDX-License-Identifier: Apache-2.0

"""Robot and scene are those of docs/reference/plant.md; bad files are refused; GL is not needed."""

import os
import sys
from contextlib import nullcontext

import pytest

from cloudrc.base.errors import BadInputError, MissingPrerequisiteError
from cloudrc.base.outside.values import InvalidValueError
from cloudrc.config.disturbances import Plant
from cloudrc.config.robot import find_robot
from cloudrc.config.shipped import file_of, names
from cloudrc.config.world import ResolvedWorld
from cloudrc.physics.sim.engine import import_mujoco
from cloudrc.physics.sim.scene import bodies_of_geoms
from cloudrc.robots.build import check_robot
from cloudrc.robots.pelican.rotors import STOPPED
from tests.support.programs import loaded
from tests.world.conftest import model_of, simulate

FILES = {"robot": find_robot("pelican").model, "scene": file_of("empty")}
ROBOTS, SCENES = names("robot"), names("scene")


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("robot", ROBOTS)
def test_every_robot_compiles_in_every_scene(robot, scene, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert model_of(robot, scene).opt.timestep == 0.002
    assert not list(tmp_path.iterdir()), "MuJoCo wrote a log"


@pytest.mark.parametrize(
    "floor", ['type="plane" size="20 20 1"', 'type="box" size="9 9 1" pos="0 0 -1"']
)
@pytest.mark.parametrize("plant", [None, Plant(mass_factor=1.1)])
@pytest.mark.parametrize(("leg", "start"), [(0.05, 0.1), (0.1, 0.1), (0.15, 0.15), (0.4, 0.4)])
def test_a_robot_with_long_legs_starts_on_the_floor(tmp_path, floor, plant, leg, start):
    robot, scene = tmp_path / "robot.xml", tmp_path / "scene.xml"
    legs = f'<geom type="capsule" size=".01" fromto=".2 0 0 .2 0 {0.01 - leg}"/>'
    robot.write_text(
        f"""<mujoco><worldbody><body><freejoint/><geom size=".04"/>{legs}<site name="up"/></body>
        </worldbody><actuator><motor site="up" gear="0 0 1 0 0 0"/></actuator></mujoco>"""
    )
    text = FILES["scene"].read_text()
    assert 'type="plane" size="20 20 1"' in text
    scene.write_text(text.replace('type="plane" size="20 20 1"', floor))
    model = model_of(str(robot), str(scene), plant)
    assert model.qpos0[:3] == pytest.approx([0, 0, start], abs=1e-6)


@pytest.mark.parametrize(
    ("place", "touched"),
    [
        ((0.0, 0.0, 0.1), set()),
        # The rear rotor's rim reaches x = -.338; pipe 1's outside is at -1 + .7 = -.3.
        ((0.0, 0.0, 0.75), {("pipe_1", False)}),
        ((0.2, 0.0, 0.75), set()),
        ((8.134, -6.42, 0.7), set()),  # the tip meets the board with the base at 8.135
        ((8.136, -6.42, 0.7), {("board", True)}),
    ],
)
def test_what_the_robot_touches(scene_at, place, touched):
    simulator = simulate("pelican", scene_at(*place))
    simulator.step(STOPPED)
    assert {(touch.body, touch.by_probe) for touch in simulator.take_contacts()} == touched


BODIES = """
  <geom type="box" size=".1 .1 .1" pos="3 0 1"/>
  <body name="robot" pos="4 0 1"><geom size=".1"/></body>
  <body pos="5 0 1"><geom size=".1"/><body name="in"><geom size=".1"/><body><geom size=".1"/></body></body></body>
  <body pos="6 0 1"><geom size=".1"/></body>
  <body name="a/b" pos="7 0 1"><geom type="capsule" size=".1 .1"/></body>
  <body name="mocap" mocap="true" pos="8 0 1"><geom type="cylinder" size=".1 .1"/></body>
  <body name="seen" pos="9 0 1"><geom type="ellipsoid" size=".1 .1 .1" contype="0" conaffinity="0"/></body>
"""  # noqa: E501
EXCLUDE = '<contact><exclude body1="a/b" body2="mocap"/></contact>'


def test_each_geom_has_the_name_of_its_body_and_the_robot_none(tmp_path, scene_with):
    """MuJoCo fuses static bodies, but not those that `exclude` or mocap names."""
    robot = tmp_path / "robot.xml"
    text = FILES["robot"].read_text()
    robot.write_text(text.replace("<worldbody>", '<worldbody><geom size=".1" pos="0 0 2"/>'))
    names = bodies_of_geoms(model_of(str(robot), scene_with(BODIES, EXCLUDE)))
    assert sorted(filter(None, names)) == [
        *("a/b", "floor", "in", "in", "mocap", "robot", "seen"),
        *("unnamed body 1", "unnamed body 2", "world", "world"),
    ]
    robot_alone = bodies_of_geoms(model_of(str(FILES["robot"]), str(FILES["scene"])))
    assert names.count("") == robot_alone.count("")


@pytest.mark.parametrize(
    ("kind", "old", "new", "message"),
    [
        ("robot", 'size=".05 .05 .10"', 'size=".05 nan .10"', "does not compile"),
        ("scene", 'name="spawn"', 'name="start"', "needs a frame named spawn"),
        ("scene", "</worldbody>", "<body><freejoint/><geom size='1'/></body></worldbody>",
                  "body without a name has a joint"),
        ("robot", 'size=".05 .05 .10"', 'size=".05 .05 .10" margin=".3"', "has a margin or gap"),
    ],
)  # fmt: skip
def test_what_cannot_be_flown_is_refused_by_name(tmp_path, monkeypatch, kind, old, new, message):
    monkeypatch.chdir(tmp_path)
    path, good = tmp_path / "mine.xml", FILES[kind].read_text()
    assert old in good
    path.write_text(good.replace(old, new))
    with pytest.raises(BadInputError, match=rf"^[^\n]*mine.xml[^\n]*{message}[^\n]*$"):
        check_robot(ResolvedWorld(**{kind: str(path)}))
    assert list(tmp_path.iterdir()) == [path], "MuJoCo wrote a log"


POLE = '<body name="pole" pos="9 0 1"><geom size=".1" contype="{}" conaffinity="{}"/></body>'


@pytest.mark.parametrize(
    ("robot_bits", "pole_bits", "message"),
    [
        ((1, 0), (1, 1), ""),  # as of robots whose parts shall not touch one another
        ((0, 0), (1, 1), "no geom of the robot can touch anything"),
        ((3, 3), (2, 2), "has contype 3 and conaffinity 3, which"),
    ],
)
def test_a_robot_meets_what_the_path_check_says_or_is_refused(
    tmp_path, scene_with, robot_bits, pole_bits, message
):
    """Otherwise it flies through a pole without a word, or hits a body that is no obstacle."""
    robot = tmp_path / "robot.xml"
    contype, conaffinity = robot_bits
    text = find_robot("x2").model.read_text()
    bits = f'<default><geom contype="{contype}" conaffinity="{conaffinity}"/>'
    robot.write_text(text.replace("<default>", bits, 1))
    assert bits in robot.read_text()
    scene = scene_with(POLE.format(*pole_bits))
    expected = pytest.raises(InvalidValueError, match=message) if message else nullcontext()
    with expected:
        model_of(str(robot), scene)


@pytest.mark.parametrize("wanted", [None, "egl"])
def test_it_is_imported_without_gl(monkeypatch, wanted):
    """The variable is restored for a child process that renders."""
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    if wanted is not None:
        monkeypatch.setenv("MUJOCO_GL", wanted)
    import_mujoco()
    assert os.environ.get("MUJOCO_GL") == wanted
    imports = "from cloudrc.config.world import ResolvedWorld as World"
    loaded(f"{imports}\nfrom cloudrc.robots.build import check_robot\ncheck_robot(World())")


def test_without_the_package_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(MissingPrerequisiteError, match=r"cloudrc\[world\]") as error:
        import_mujoco()
    assert error.value.exit_code == 3
