# SPDX-License-Identifier: Apache-2.0

"""A mission whose setpoint waits for the robot: how far is its path off that over an ideal link?"""

import pytest

from cloudrc.flight.experiment import load
from cloudrc.flight.trials.beside_ideal import fly_beside_ideal
from tests.conftest import nightly_rows

P3 = ["link.profile=paper-p3"]
FAR = [
    *("link.profile=ideal", "link.both.delay_ms=150"),
    *("guard.command_age_max_ms=900", "cloud.freeze_after_s=1"),
]


NEAR = "mission.waypoints=[{position_m: [0.5, 0, 0.7]}]", "mission.touch=null"


def fly(*settings):
    experiment = load("paper", [*settings]).model_copy(update={"seed": 2})
    row = fly_beside_ideal(experiment)
    return row["verdict"], row["numbers"]


@pytest.mark.parametrize(
    ("link", "predictor", "verdict", "off"),
    [
        (P3, "constant_velocity", "success", 0.0050),
        *nightly_rows(
            (FAR, "constant_velocity", "success", 0.0098),
            (P3, "last_sample", "success", 0.0124),
            (FAR, "last_sample", "failure", 0.0432),
        ),
    ],
)
def test_a_loop_that_fails_is_farther_off_than_one_that_flies(link, predictor, verdict, off):
    """The values are those by hand; J/J0 of the last row is smaller than that of the second."""
    found, numbers = fly(*link, f"cloud.predictor={predictor}")
    assert found == verdict
    assert numbers["off_ideal_path"] == pytest.approx(off, rel=0.05)


def test_over_an_ideal_link_nothing_is_off():
    _, numbers = fly("link.profile=ideal", *NEAR)
    assert (numbers["off_ideal_path"], numbers["T/T0"]) == (0.0, 1.0)
