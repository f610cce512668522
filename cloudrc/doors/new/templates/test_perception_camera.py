# SPDX-License-Identifier: Apache-2.0

"""Fly with the perception beside this file, in virtual time; pytest runs it."""

from pathlib import Path

import cloudrc

PERCEPTION = str(Path(__file__).with_name("perception_camera.py"))


def test_the_robot_turns_to_what_it_sees() -> None:
    """The drone keeps a moving board in the picture for six seconds."""
    settings = {"cloud.perception": PERCEPTION, "mission.follow.duration_s": 6}
    flight = cloudrc.fly("follow", settings)
    assert flight.verdict == "success", flight
