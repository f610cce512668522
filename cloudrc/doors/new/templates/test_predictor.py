# SPDX-License-Identifier: Apache-2.0

"""Fly with the predictor beside this file, in virtual time; pytest runs it."""

from pathlib import Path

import cloudrc

PREDICTOR = str(Path(__file__).with_name("predictor.py"))


def test_the_robot_flies_with_the_predictor() -> None:
    """A mission succeeds over the delays of a mobile network."""
    flight = cloudrc.fly("steps", {"cloud.predictor": PREDICTOR, "link.profile": "lte"})
    assert flight.verdict == "success", flight
    assert flight.numbers["prediction_error_rms"] < 0.2  # [m]
