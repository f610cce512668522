# SPDX-License-Identifier: Apache-2.0

"""The perception target goes to its distance from a coloured body, by hand."""

from dataclasses import replace
from math import atan, cos, pi, radians, sin, tan

import numpy as np
import pytest

from cloudrc.cloud.perceptions import Frame
from cloudrc.cloud.perceptions.target import build
from cloudrc.wire.messages import ZERO, Odometry
from tests.support.robots import facts_of

X2 = facts_of("x2", 4.0)
WIDTH, HEIGHT, FOVY = 320, 240, radians(60)
FOCAL = HEIGHT / 2 / tan(FOVY / 2)
RED, SHADE, GREY, ORANGE = (230, 26, 20), (115, 13, 10), (120, 125, 140), (230, 130, 20)


def robot(yaw=0.0, position=(0.0, 0.0, 1.5)):
    return Odometry(0, position, (cos(yaw / 2), 0.0, 0.0, sin(yaw / 2)), ZERO, ZERO)


def picture(left=0.0, up=0.0, ahead=4.0, colour=RED, size=0.6):
    """Draw a square body at a place [m] in the frame of the camera."""
    image = np.full((HEIGHT, WIDTH, 3), GREY, np.uint8)
    column, row = WIDTH / 2 - FOCAL * left / ahead, HEIGHT / 2 - FOCAL * up / ahead
    half = FOCAL * size / ahead / 2
    rows, columns = ((round(c - half), round(c + half)) for c in (row, column))
    image[slice(*rows), slice(*columns)] = colour
    return Frame(7, 0, image, FOVY)


@pytest.mark.parametrize("colour", [RED, SHADE])
@pytest.mark.parametrize("yaw", [0.0, pi / 2, -2.0])
def test_it_keeps_its_distance_and_looks_at_the_body(yaw, colour):
    setpoint = build(X2).see(picture(left=1.0, up=0.3, ahead=4.0, colour=colour), robot(yaw))
    heading, away = yaw + atan(1.0 / 4.0), 17**0.5 - 3.0
    expected = away * cos(heading), away * sin(heading), 1.8
    assert setpoint.position == pytest.approx(expected, abs=0.06)
    assert setpoint.turns
    assert cos(setpoint.yaw - heading) == pytest.approx(1.0, abs=1e-4)


def test_a_tilted_robot_finds_the_same_place():
    """It pitches down by 0.2 rad, so that a body at its height is higher in the picture."""
    tilted = robot()._replace(orientation_wxyz=(cos(0.1), 0.0, sin(0.1), 0.0))
    setpoint = build(X2).see(picture(up=4.0 * tan(0.2), ahead=4.0), tilted)
    assert setpoint.position == pytest.approx((4.0 / cos(0.2) - 3.0, 0.0, 1.5), abs=0.06)


def test_single_points_of_its_colour_do_not_count():
    seen = picture()
    seen.image[5, 300] = seen.image[230, 10] = RED
    clean, noisy = (build(X2).see(each, robot()) for each in (picture(), seen))
    assert noisy == clean


@pytest.mark.parametrize("seen", [picture(colour=GREY), picture(colour=ORANGE), picture(size=0.03)])
def test_without_the_body_the_last_setpoint_stays(seen):
    assert build(X2).see(seen, robot()) is None


@pytest.mark.parametrize("heading", ["fixed", "velocity"])
def test_a_robot_that_cannot_turn_is_refused(heading):
    with pytest.raises(ValueError, match=f"heading of x2 is {heading}"):
        build(replace(X2, heading=heading))
