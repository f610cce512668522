"""The numbers in README.md are those of this version: within the intervals of a new sweep."""

import re
from pathlib import Path

import numpy as np
import pytest

from tests.conftest import nightly
from tests.flights.conftest import fly
from tools.results import LINKS, NUMBERS, PREDICTORS, sweep


def row(name):
    """Return the cells of the row that begins with a name, as texts."""
    text = (Path(__file__).parents[1] / "README.md").read_text("utf-8")
    (line,) = re.findall(rf"^\| `{name}`.*$", text, re.MULTILINE)
    return [cell.strip() for cell in line.strip("|").split("|")]


@pytest.mark.full
@pytest.mark.parametrize("profile", LINKS)
def test_the_mission_on_the_links_of_the_paper(profile):
    found, (_, done, *cells) = sweep("paper", f"link.profile={profile}"), row(profile)
    assert done == f"{found['done']}/{found['count']}" == "10/10"
    for cell, (name, (factor, _, digits)) in zip(cells, NUMBERS.items(), strict=True):
        low, high = (factor * value for value in found["numbers"][name]["interval"])
        rounding = 0.5 * 10.0**-digits
        assert low - rounding <= float(cell.partition(" ")[0]) <= high + rounding, name


@pytest.mark.full
@pytest.mark.parametrize("predictor", PREDICTORS)
def test_the_prediction_error_of_each_predictor(predictor):
    found, (_, cell) = sweep("steps", f"cloud.predictor={predictor}"), row(predictor)
    low, high = found["numbers"]["prediction_error_rms"]["interval"]
    assert 1e3 * low - 0.05 <= float(cell.partition(" ")[0]) <= 1e3 * high + 0.05


@pytest.mark.full
@pytest.mark.parametrize("profile", LINKS)
@pytest.mark.parametrize("predictor", PREDICTORS)
def test_the_steps_succeed_with_every_predictor_on_the_links_of_the_paper(profile, predictor):
    found = sweep("steps", f"link.profile={profile}", f"cloud.predictor={predictor}")
    assert found["done"] == found["count"] == 10


@pytest.mark.parametrize("seed", [1, *nightly(*range(2, 11))])
def test_high_gains_without_a_predictor_are_unstable(seed):
    gains = "cloud.controller={name: pid, gain_p: [6, 6, 6]}"
    flight = fly("steps", gains, "cloud.predictor=last_sample", f"seed={seed}")
    assert "unstable" in [failure.code for failure in flight.verdict.failures]


@pytest.mark.parametrize(
    "case",
    nightly(
        ("steps", "running_mean", 1.0, 21.0),
        ("steps", "split", 2.0, 15.3),
        ("paper-verbatim", "running_mean", 1.0, 34.0),
    ),
)
def test_the_delay_estimate_has_no_bias(case):
    """Mean of seeds 1 to 3 under paper-p3, from the first echo on [ms]."""
    experiment, estimator, bias_max, rms_max = case
    biases, squares = [], []
    for seed in (1, 2, 3):
        settings = ("link.profile=paper-p3", f"cloud.estimator={estimator}", f"seed={seed}")
        applied = fly(experiment, *settings).flight.applied
        delay_ms = (applied["stamp_ns"] - applied["basis_stamp_ns"]) * 1e-6
        errors = (applied["horizon"] * 1e3 - delay_ms)[np.isfinite(applied["rtt"])]
        biases.append(errors.mean())
        squares.append((errors**2).mean())
    assert abs(np.mean(biases)) <= bias_max
    assert np.sqrt(np.mean(squares)) <= rms_max
