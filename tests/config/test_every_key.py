"""Every key of the schema can be set; a typo, a wrong type and a wrong range are refused."""

from __future__ import annotations

import re
from typing import Any

import pytest

from cloudrc.config import problems
from cloudrc.config.load import dump, load_experiment
from cloudrc.config.schema import Experiment
from cloudrc.errors import BadInputError
from tests.config.conftest import LEAVES, base, beside, setting, valid


def refusal(key: str, value: Any, *others: str) -> str:
    with pytest.raises(BadInputError) as caught:
        load_experiment(base(key), [*others, setting(key, value)])
    return str(caught.value)


def words(key: str) -> str:
    return problems.expectation(Experiment, tuple(key.split(".")))


def value_at(tree: Any, key: str) -> Any:
    for step in key.split("."):
        tree = tree[int(step)] if isinstance(tree, list) else tree[step]
    return tree


RANGED = [key for key in LEAVES if ">" in words(key)]


@pytest.mark.parametrize("key", LEAVES)
def test_set_reaches_the_key(key: str) -> None:
    value = valid(key)
    tree = load_experiment(base(key), [*beside(key), setting(key, value)]).model_dump(mode="json")
    found = value_at(tree, key)
    if key == "mission":
        assert len(found["waypoints"]) == 1
    elif key in ("cloud.estimator", "cloud.predictor", "cloud.controller"):
        assert found["name"] == value
    else:
        assert found == value


@pytest.mark.parametrize("key", LEAVES)
def test_typo_is_refused_with_the_nearest_key(key: str) -> None:
    above, dot, last = key.rpartition(".")
    typo = f"{above}{dot}{last[:-1]}{'x' if last[-1] != 'x' else 'y'}{last[-1]}"
    text = refusal(typo, valid(key), *beside(key))
    assert f"{typo}: unknown key" in text
    plug_in = above.startswith("cloud.")  # parameters depend on the plug-in; see test_plugins
    assert plug_in or f"did you mean {last}" in text


@pytest.mark.parametrize("key", LEAVES)
def test_wrong_type_is_refused(key: str) -> None:
    wrong = 3 if "text" in words(key) or "true or" in words(key) else [["a"]]
    text = refusal(key, wrong, *beside(key))
    assert f"--set: {key}" in text
    assert "must be" in text


@pytest.mark.parametrize(
    "key", [key for key in LEAVES if words(key).startswith("must be a number")]
)
def test_text_is_refused_as_a_number_an_integer_is_not(key: str) -> None:
    assert "must be a number" in refusal(key, "1", *beside(key))
    load_experiment(base(key), [*beside(key), setting(key, 0 if key.endswith("yaw_deg") else 1)])


@pytest.mark.parametrize("key", RANGED)
@pytest.mark.parametrize("value", [-1, float("nan"), float("inf")])
def test_out_of_range_is_refused(key: str, value: float) -> None:
    text = refusal(key, value, *beside(key))
    assert f"--set: {key}: {'-1' if value == -1 else ''}" in text
    if value == -1:
        assert words(key) in text


@pytest.mark.parametrize("key", [key for key in RANGED if "<= " in words(key)])
def test_above_the_upper_limit_is_refused(key: str) -> None:
    (limit,) = re.findall(r"<= ([\d.]+)", words(key))
    above = int(limit) + 1 if "whole" in words(key) else 1.001 * float(limit)
    assert words(key) in refusal(key, above, *beside(key))


@pytest.mark.parametrize("key", RANGED)
def test_every_number_has_a_unit_or_is_a_share_or_a_count(key: str) -> None:
    assert "[" in words(key) or "<=" in words(key) or key == "seed"


def test_every_key_is_described() -> None:
    assert [key for key, field in LEAVES.items() if not field.description] == []


def test_a_dump_has_every_key_outside_of_alternatives() -> None:
    text = dump(load_experiment("paper"))
    alternatives = ("mission.steps", ".loss.", ".changes.0", ".blackouts.0")
    missing = [
        key
        for key in LEAVES
        if not any(part in key for part in alternatives)
        and f"{key.rpartition('.')[2]}:" not in text
    ]
    assert missing == []
