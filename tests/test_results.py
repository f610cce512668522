"""The numbers in README.md are those of this version: within the intervals of a new sweep."""

import re
from pathlib import Path

import pytest

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
    assert found["done"] == found["count"] == 10
