"""The published controller flies what is like the Pelican, and says why it refuses others."""

import pytest

from cloudrc.config.robot import find_robot
from cloudrc.config.shipped import file_of
from cloudrc.robots.pelican.fit import check_fit
from cloudrc.sim.scene import compile_model

PELICAN, EMPTY = find_robot("pelican").model, file_of("empty")


def changed(folder, file, old, new):
    """Write a copy of a file in which `old` is `new`; return its path."""
    text = file.read_text()
    assert old in text
    path = folder / file.name
    path.write_text(text.replace(old, new))
    return path


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('name="rotor_left" site', 'name="rotor_5" site', "needs the actuators"),
        ('mass="1.0"', 'mass="1.265"', r"a mass of 1.06 \+- 0.1 kg .*, not 1.325 and 9.8"),
    ],
)
def test_a_robot_that_is_not_like_the_pelican_is_refused_by_its_difference(
    tmp_path, old, new, message
):
    robot = changed(tmp_path, PELICAN, old, new)
    with pytest.raises(ValueError, match=message) as error:
        check_fit(compile_model(robot, EMPTY))
    assert "\n" not in str(error.value)


def test_air_that_mujoco_simulates_is_refused_by_the_scenes_option(tmp_path):
    scene = changed(tmp_path, EMPTY, "<option ", '<option density="1.2" ')
    with pytest.raises(ValueError, match=r"the scene has the option density"):
        check_fit(compile_model(PELICAN, scene))
