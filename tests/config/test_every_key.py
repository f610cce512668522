"""Every key of the schema can be reached: a wrong type and a wrong range are refused there."""

import json
import re

import pytest

from cloudrc.config import problems
from cloudrc.config.load import load_experiment
from cloudrc.config.resolved import dump
from cloudrc.config.schema import Experiment
from tests.config.conftest import refused

LEAVES = {".".join(path): field for path, field in problems.leaves(Experiment)}


def words(key):
    return problems.expectation(Experiment, tuple(key.split(".")))


ONE_WAY = [key for key in LEAVES if "downlink" not in key]  # uplink and downlink are alike
RANGED = [key for key in ONE_WAY if ">" in words(key)]


def base(key):
    """Name a shipped experiment in which the key can be set."""
    return "steps" if key == "mission" or key.startswith("mission.steps") else "paper"


def refusal(key, value):
    return refused(base(key), f"{key}={json.dumps(value)}")


@pytest.mark.parametrize("key", ONE_WAY)
def test_wrong_type_is_refused(key):
    wrong = 3 if "text" in words(key) or "true or" in words(key) else [["a"]]
    text = refusal(key, wrong)
    assert f"--set: {key}" in text
    assert "must be" in text


@pytest.mark.parametrize("key", RANGED)
def test_out_of_range_is_refused(key):
    above = [1.001 * float(limit) for limit in re.findall(r"<= ([\d.]+)", words(key))]
    below = [int(limit) - 1 for limit in re.findall(r">= (-\d+)", words(key))] or [-1]
    for value in (
        *below,
        *((int(limit) + 1 for limit in above) if "whole" in words(key) else above),
    ):
        text = refusal(key, value)
        assert f"--set: {key}: " in text
        assert words(key) in text
    assert f"--set: {key}: inf: must be" in refused(base(key), f"{key}=.inf")
    assert "[" in words(key) or "<=" in words(key) or key == "seed", "a unit, a share or a count"


def test_every_key_is_described_and_dumped():
    text = dump(load_experiment("paper"))
    optional = ("mission.steps", "mission.carrot", ".loss.", ".changes.0", ".blackouts.0")
    for key, field in LEAVES.items():
        assert field.description, key
        assert any(part in key for part in optional) or f"{key.rpartition('.')[2]}:" in text, key
