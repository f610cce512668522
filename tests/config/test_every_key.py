"""Every key of the schema can be set; a wrong type and a wrong range are refused."""

import json
import re
from typing import Literal, get_args, get_origin

import pytest

from cloudrc.config import problems
from cloudrc.config.load import dump, load_experiment
from cloudrc.config.schema import Experiment
from tests.config.conftest import refused

LEAVES = {".".join(path): field for path, field in problems.leaves(Experiment)}
SPECIAL = {
    "mission": "hover",
    "mission.waypoints.0.position_m": [0.6, 0.1, 0.8],
    "mission.waypoints.0.yaw_deg": 0,  # the only heading that the onboard controller holds
    "mission.steps.centre_m": [0.1, 0.2, 1.1],
    "mission.steps.range_m": [0.5, 0.5, 0.5],
    "guard.command_age_max_ms": 300,
    "cloud.command_rate_hz": 50,
    "world.robot": "pelican",
    "world.scene": "empty",
    "link.profile": "paper-p3",
    "mission.setpoints": None,
    **{f"link.{way}link.{key}": None for way in ("up", "down") for key in ("trace", "table")},
    **{f"link.{way}link.distribution": "pareto" for way in ("up", "down")},
    "cloud.estimator": "split",
    "cloud.estimator.name": "ewma",
    "cloud.predictor": "last_sample",
    "cloud.predictor.name": "last_sample",
    "cloud.controller": "pid",
    "cloud.controller.name": "pid",
    "report.metrics": ["duration"],
}
NEEDED = {
    "cloud.plan_s": "cloud.predictor=model_based",
    "cloud.compute_deviation_ms": "cloud.compute_ms=5",
    "mission.waypoints.0.speed_mps": "mission.carrot={}",
}


def words(key):
    return problems.expectation(Experiment, tuple(key.split(".")))


ONE_WAY = [key for key in LEAVES if "downlink" not in key]  # uplink and downlink are alike
RANGED = [key for key in ONE_WAY if ">" in words(key)]


def valid(key):
    """Return a valid value of the key, different from its default if possible."""
    if key in SPECIAL:
        return SPECIAL[key]
    field = LEAVES[key]
    if get_origin(field.annotation) is Literal:
        return get_args(field.annotation)[-1]
    known = {"list of 2": [0.25, 0.5], "list of 3": [0.25, 0.5, 0.75],
             "list of 4": [1.0, 0.5, 0.75, 2.0], "whole number": 7, "number": 0.5,
             "true or false": not field.default}  # fmt: skip
    return next((value for word, value in known.items() if word in words(key)), "some text")


def beside(key):
    """List the settings that the key needs."""
    above, _, last = key.rpartition(".")
    if key in NEEDED:
        return [NEEDED[key]]
    if above.endswith(".loss"):
        needed = {"bad_start": 0.1, "bad_end": 0.5}
        found = [f"{above}.{name}={value}" for name, value in needed.items() if name != last]
        return [*found, *beside(above)]
    if above.endswith("changes.0") and last != "at_s":
        return [f"{above}.at_s=3"]
    if above.endswith("blackouts.0"):
        other = {"start_s": "duration_s", "duration_s": "start_s"}[last]
        return [f"{above}.{other}=2"]
    return []


def base(key):
    """Name a shipped experiment in which the key can be set."""
    return "steps" if key == "mission" or key.startswith("mission.steps") else "paper"


def setting(key, value):
    return f"{key}={json.dumps(value)}"


def refusal(key, value):
    return refused(base(key), *beside(key), setting(key, value))


def value_at(tree, key):
    for step in key.split("."):
        tree = tree[int(step)] if isinstance(tree, list) else tree[step]
    return tree


@pytest.mark.parametrize("key", LEAVES)
def test_set_reaches_the_key(key):
    value = valid(key)
    tree = load_experiment(base(key), [*beside(key), setting(key, value)]).model_dump(mode="json")
    found = value_at(tree, key)
    if key == "mission":
        assert len(found["waypoints"]) == 1
    else:
        named = key in ("cloud.estimator", "cloud.predictor", "cloud.controller")
        assert (found["name"] if named else found) == value


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
    assert f"--set: {key}: inf: must be" in refused(base(key), *beside(key), f"{key}=.inf")
    assert "[" in words(key) or "<=" in words(key) or key == "seed", "a unit, a share or a count"


def test_every_key_is_described_and_dumped():
    text = dump(load_experiment("paper"))
    optional = ("mission.steps", "mission.carrot", ".loss.", ".changes.0", ".blackouts.0")
    for key, field in LEAVES.items():
        assert field.description, key
        assert any(part in key for part in optional) or f"{key.rpartition('.')[2]}:" in text, key
