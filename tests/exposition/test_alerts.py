"""What each fault fires of the chart's alerts: the documentation's table, held against flights."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest
import yaml
from flown_metrics import RULES, fired

from cloudrc.faults.catalogue import find, scenarios
from cloudrc.faults.flight import Flight
from cloudrc.faults.scenario import Scenario

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "safety" / "alerts.md").read_text(encoding="utf-8")
MADE_UP = (ROOT / "tests" / "e2e" / "alerts.yaml").read_text(encoding="utf-8")
ROWS = re.findall(r"^\| (F\d+) ([\w-]+) \| (.*) \| ?(.*) ?\|$", PAGE, re.MULTILINE)
QUICK = ("F8", "F13", "F17", "F18", "F25", "F28")
FLOWN = [
    pytest.param(each, marks=[] if each.id in QUICK else pytest.mark.full, id=each.name)
    for each in scenarios("virtual")
]


def alerts() -> set[str]:
    groups = yaml.safe_load(RULES.read_text(encoding="utf-8"))["groups"]
    return {rule["alert"] for group in groups for rule in group["rules"] if "alert" in rule}


def test_every_fault_is_in_the_table_and_every_alert_that_there_is_and_no_other() -> None:
    assert [int(number[1:]) for number, *_ in ROWS] == list(range(1, 41))
    for number, name, *_ in ROWS:
        assert name in {each.name for each in scenarios() if each.id == number}
    assert set(re.findall(r"Cloudrc\w+", PAGE)) == alerts()


def test_every_alert_is_tried_with_series_that_fire_it() -> None:
    tried = [
        check for test in yaml.safe_load(MADE_UP)["tests"] for check in test["alert_rule_test"]
    ]
    assert {check["alertname"] for check in tried if check.get("exp_alerts")} == alerts()


@pytest.fixture
def flights(monkeypatch: pytest.MonkeyPatch) -> list[Flight]:
    """All that are flown in a test."""
    if shutil.which("promtool") is None:
        pytest.skip("no promtool here (Debian package prometheus)")
    made: list[Flight] = []
    init = Flight.__init__

    def remembered(self: Flight, *settings: str, **options: object) -> None:
        made.append(self)
        init(self, *settings, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(Flight, "__init__", remembered)
    return made


@pytest.mark.parametrize("scenario", FLOWN)
def test_a_fault_fires_its_alerts_and_no_others(
    scenario: Scenario, flights: list[Flight], tmp_path: Path
) -> None:
    (told,) = (cell for number, _, cell, _ in ROWS if number == scenario.id)
    find(scenario.name, "virtual").run(1)
    found = [fired(flight, tmp_path) for flight in flights if flight.of_world]
    assert sorted(set[str]().union(*found)) == re.findall(r"Cloudrc\w+", told)


@pytest.mark.parametrize("profile", ["paper-p1", "paper-p3", "wifi"])
def test_a_clean_flight_fires_none(profile: str, flights: list[Flight], tmp_path: Path) -> None:
    flight = Flight(f"link.profile={profile}").fly_mission()
    assert flight.mission.state == "done"
    assert flights == [flight]
    assert fired(flight, tmp_path) == set()
