"""A slice of a search that contradicts itself is not added up."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from cloudrc.cli.faults_page import INVARIANTS
from cloudrc.cli.faults_slices import document, keep
from cloudrc.cli.main import main

SLICE = Path("a.json")


@pytest.fixture
def told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """A slice of three flights, in one of which the robot was not expected to get on."""
    monkeypatch.chdir(tmp_path)
    flights = [
        {
            **{"judged": judged, "kinds": (), "margin": 0.1, "speed": 1.0, "holds": 0},
            **{"missions": 1, "fallen": 0.0, "thrown": 0.0, "landed_on": False, "duration": 60.0},
        }
        for judged in (INVARIANTS, INVARIANTS, INVARIANTS.keys() - {"stuck"})
    ]
    return document(flights, [], kind="random", first=1, seconds=1.0, sources="ab")


def test_one_without_a_contradiction_is_added_up(told: dict[str, Any]) -> None:
    keep(told | {"first": 0}, SLICE)
    assert main(["faults", "merge", "a.json"]) == 0


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"count": 10**30}, "looked at in 3 flights"),
        ({"count": 10**400}, "looked at in 3 flights"),
        ({"count": 2}, "count 2, but its invariants were looked at in 3 flights"),
        ({"first": -10}, "its first seed is -10, below 0"),
    ],
)
def test_a_count_or_a_seed_that_cannot_be_is_refused(
    values: dict[str, int], said: str, told: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    keep(told | values, SLICE)
    refused(said, capsys)


@pytest.mark.parametrize("broken", [-1, 3, 10**30])
def test_more_flights_that_broke_it_than_looked_at_it_are_refused(
    broken: int, told: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    told["invariants"]["stuck"]["broken"] = broken
    keep(told, SLICE)
    refused(f"stuck: broken in {broken} of 2 flights", capsys)


def refused(said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main("faults merge a.json --slice sum.json --document page.md".split()) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("cloudrc: error: a.json: ")
    assert said in line
    assert list(Path().iterdir()) == [SLICE]
