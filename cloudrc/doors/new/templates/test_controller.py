# SPDX-License-Identifier: Apache-2.0

"""Fly with the controller beside this file, in virtual time; pytest runs it."""

from pathlib import Path

import cloudrc

CONTROLLER = str(Path(__file__).with_name("controller.py"))


def test_the_robot_flies_with_the_controller() -> None:
    """A mission succeeds over the delays of a mobile network."""
    flight = cloudrc.fly("hover", {"cloud.controller": CONTROLLER, "link.profile": "lte"})
    assert flight.verdict == "success", flight
    assert flight.numbers["tracking_rms_measured"] < 0.5  # [m]
