# SPDX-License-Identifier: Apache-2.0

"""Fly with the estimator beside this file, in virtual time; pytest runs it."""

from pathlib import Path

import cloudrc

ESTIMATOR = str(Path(__file__).with_name("estimator.py"))


def test_the_robot_flies_with_the_estimator() -> None:
    """A mission succeeds over the delays of a mobile network, and the horizon is near them."""
    flight = cloudrc.fly("steps", {"cloud.estimator": ESTIMATOR, "link.profile": "lte"})
    assert flight.verdict == "success", flight
    assert flight.numbers["delay_estimate_error_rms"] < 0.05  # [s]
