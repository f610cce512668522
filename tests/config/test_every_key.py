"""Every key of the schema can be set; a typo, a wrong type and a wrong range are refused."""

import re

import pytest

from cloudrc.config.load import dump, load_experiment
from tests.config.conftest import LEAVES, base, beside, refused, setting, valid, words

ONE_WAY = [key for key in LEAVES if "downlink" not in key]  # both directions have one model
RANGED = [key for key in ONE_WAY if ">" in words(key)]


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
def test_typo_is_refused_with_the_nearest_key(key):
    above, dot, last = key.rpartition(".")
    typo = f"{above}{dot}{last[:-1]}{'x' if last[-1] != 'x' else 'y'}{last[-1]}"
    text = refused(base(key), *beside(key), setting(typo, valid(key)))
    assert f"{typo}: unknown key" in text
    plug_in = above.startswith("cloud.")  # parameters depend on the plug-in; see test_plugins
    assert plug_in or f"did you mean {last}" in text


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
