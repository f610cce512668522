# SPDX-License-Identifier: Apache-2.0

"""The renderer agrees with geometry computed by hand, repeats, and leaves the flight alone."""

import sys
from math import cos, radians, sin, tan

import numpy as np
import pytest

from cloudrc.base.errors import MissingPrerequisiteError
from cloudrc.config.camera import CameraConfig
from cloudrc.config.shipped import file_of
from cloudrc.physics.sim import camera as module
from cloudrc.physics.sim.camera import Camera, find_renderer
from cloudrc.physics.sim.engine import at_rest
from tests.world.conftest import model_of

CONFIG = CameraConfig(name="front", fovy_deg=60.0)
BALL = (
    '<light pos="0 0 9" ambient="1 1 1" castshadow="true"/>'
    '<body name="ball" mocap="true" pos="5.1 0 1">'
    '<geom type="sphere" size=".2" rgba="1 0 0 1" contype="0" conaffinity="0"/></body>'
)
"""A red ball, 5 m before a robot at the height of 1 m, whose camera is .1 m before its base."""


@pytest.fixture
def scene(tmp_path):
    """Return the model and the flight's data of an x2 at rest, 1 m above the origin."""
    try:
        find_renderer()
    except MissingPrerequisiteError as lacks:
        pytest.skip(str(lacks))
    path = tmp_path / "ball.xml"
    path.write_text(file_of("empty").read_text().replace("</worldbody>", f"{BALL}</worldbody>"))
    model = model_of("x2", str(path))
    data = at_rest(model)
    data.qpos[:3] = 0.0, 0.0, 1.0
    return model, data


def red(image):
    """Return the mean row and column of what is red, and how many pixels that are."""
    is_red = (image[..., 0] > 60) & (image[..., 1:].max(axis=2) < image[..., 0] // 3)
    rows, columns = np.nonzero(is_red)
    return rows.mean(), columns.mean(), len(rows)


def seen(camera):
    camera.aim()
    return camera.render()


FOCUS = 120 / tan(radians(30))
"""Distance at which a pixel is as large as the step between two [pixels]."""


@pytest.mark.parametrize("bearing_deg", [0, 10, -25])
def test_a_body_is_in_the_column_of_its_bearing(scene, bearing_deg):
    model, data = scene
    yaw = -radians(bearing_deg)
    data.qpos[3:7] = cos(yaw / 2), 0.0, 0.0, sin(yaw / 2)
    row, column, count = red(seen(Camera(model, data, CONFIG)))
    x, y = 5.1 * cos(yaw) - 0.1, -5.1 * sin(yaw)  # of the ball, from the camera
    assert column == pytest.approx(159.5 - FOCUS * y / x, abs=1.0)
    assert row == pytest.approx(119.5, abs=1.0)
    assert count == pytest.approx(np.pi * (0.2 * FOCUS / x) ** 2, rel=0.2)


def test_a_body_that_world_moves_is_seen_where_it_is(scene):
    model, data = scene
    camera = Camera(model, data, CONFIG)
    data.mocap_pos[0] = 5.1, 1.0, 2.0
    camera.aim()
    data.mocap_pos[0] = 5.1, 0.0, 1.0  # after the picture was taken
    row, column, _ = red(camera.render())
    assert (row, column) == pytest.approx((119.5 - FOCUS / 5, 159.5 - FOCUS / 5), abs=1.5)


def test_pictures_repeat_and_change_nothing_of_the_flight(scene):
    model, data = scene
    before = data.qpos.copy(), data.geom_xpos.copy(), model.geom_group.copy(), model.cam_fovy.copy()
    first, again = (seen(Camera(model, data, CONFIG)) for _ in range(2))
    assert first.shape == (240, 320, 3)
    assert (first == again).all()
    after = data.qpos, data.geom_xpos, model.geom_group, model.cam_fovy
    assert all((a == b).all() for a, b in zip(before, after, strict=True))


def test_the_robot_is_not_in_its_picture(scene):
    """From its base the camera would be inside of the robot."""
    model, data = scene
    camera = Camera(model, data, CONFIG)
    seen_before = seen(camera)
    camera._model.cam_pos[camera._view.fixedcamid] = 0.0
    assert red(seen(camera))[2] == pytest.approx(red(seen_before)[2], rel=0.1)


def test_a_machine_without_egl_is_told_what_to_install(scene, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco.egl", None)
    with pytest.raises(MissingPrerequisiteError, match="apt-get install libegl1") as refused:
        module._open_egl()
    assert "\n" not in str(refused.value)
