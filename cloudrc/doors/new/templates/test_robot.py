# SPDX-License-Identifier: Apache-2.0

"""Fly the robot of this folder in virtual time; pytest runs it."""

from pathlib import Path

import cloudrc

ROBOT = str(Path(__file__).parent)


def test_the_robot_hovers() -> None:
    """Robot and onboard controller fly a mission."""
    settings = {"world.robot": ROBOT, "world.scene": "empty"}
    assert cloudrc.fly("hover", settings).verdict == "success"
