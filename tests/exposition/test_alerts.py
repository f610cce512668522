"""Each fault fires exactly its alerts of the chart."""

import re
import shutil
from pathlib import Path

import pytest
import yaml

from cloudrc.faults.flight import Flight
from cloudrc.faults.scenarios import SCENARIOS
from tests.exposition.conftest import RULES, fired

ROOT = Path(__file__).resolve().parents[2]
MADE_UP = (ROOT / "tests" / "e2e" / "alerts.yaml").read_text(encoding="utf-8")
FIRES = {
    "F3": ["CloudrcHolding", "CloudrcLanded"],
    "F8": ["CloudrcTagFailures"],
    "F13": ["CloudrcCloudRestart"],
    "F17": ["CloudrcWorldRestart"],
    "F20": ["CloudrcPortScan", "CloudrcTagFailures"],
    "F21": ["CloudrcPortScan", "CloudrcTagFailures"],
    "F22": ["CloudrcPortScan", "CloudrcTagFailures"],
    "F23": ["CloudrcLanded"],
    "F24": ["CloudrcPortScan"],
    "F25": ["CloudrcCloudRestart", "CloudrcSplitBrain"],
    "F28": ["CloudrcMissionStuck"],
}
"""Fault -> the alerts that its flight fires; a fault that is not listed fires none."""
QUICK = ("F8", "F13", "F17", "F25", "F28")
FLOWN = [
    pytest.param(each, marks=[] if each.id in QUICK else pytest.mark.full, id=each.name)
    for each in SCENARIOS
]


def rules(kind):
    groups = yaml.safe_load(RULES.read_text(encoding="utf-8"))["groups"]
    return {rule[kind] for group in groups for rule in group["rules"] if kind in rule}


def test_every_alert_has_a_test_that_fires_it():
    tests = yaml.safe_load(MADE_UP)["tests"]
    tried = [check for test in tests for check in test.get("alert_rule_test", ())]
    assert {check["alertname"] for check in tried if check.get("exp_alerts")} == rules("alert")


def test_every_recording_rule_has_a_test_of_its_value():
    (test,) = (test for test in yaml.safe_load(MADE_UP)["tests"] if "promql_expr_test" in test)
    samples = [one["labels"] for one in test["promql_expr_test"][0]["exp_samples"]]
    assert {re.findall(r'rule="(.+?)"', labels)[0] for labels in samples} == rules("record")


@pytest.fixture
def flights(monkeypatch):
    """All flights of a test."""
    if shutil.which("promtool") is None:
        pytest.skip("needs promtool (Debian package prometheus)")
    made: list[Flight] = []
    init = Flight.__init__

    def remember(self, *settings, **options):
        made.append(self)
        init(self, *settings, **options)

    monkeypatch.setattr(Flight, "__init__", remember)
    return made


@pytest.mark.parametrize("scenario", FLOWN)
def test_a_fault_fires_its_alerts_and_no_others(scenario, flights, tmp_path):
    scenario.run(1)
    found = [fired(flight, tmp_path) for flight in flights if flight.of_world]
    assert sorted(set[str]().union(*found)) == FIRES.get(scenario.id, [])


@pytest.mark.parametrize("profile", ["paper-p1", "paper-p3", "wifi"])
def test_a_clean_flight_fires_none(profile, flights, tmp_path):
    flight = Flight(f"link.profile={profile}").fly_mission()
    assert flight.mission.state == "done"
    assert flights == [flight]
    assert fired(flight, tmp_path) == set()
