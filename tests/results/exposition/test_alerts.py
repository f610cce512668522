# SPDX-License-Identifier: Apache-2.0

"""Each fault fires exactly its alerts of the chart."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml

from cloudrc.results.exposition.live import LiveMetrics
from cloudrc.results.exposition.parts import Histogram
from cloudrc.results.exposition.table import METRICS
from cloudrc.wire.records import Counted
from tests.conftest import nightly
from tests.faults.flight import FaultRun
from tests.faults.scenarios import SCENARIOS
from tests.faults.schedule import Schedule

ROOT = Path(__file__).resolve().parents[3]
RULES = ROOT / "charts" / "cloudrc" / "files" / "rules.yaml"
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
QUICK = ("F8", "F17", "F25", "F28")
FLOWN = [
    pytest.param(each, marks=[] if each.id in QUICK else pytest.mark.full, id=each.name)
    for each in SCENARIOS.values()
]


PERIOD = 5
"""Time between scrapes [s]."""
AFTER = 11
"""Time for which scrapes continue after a flight [s]."""
ROLES = ("world", "cloud", "teleop")


def series(flight):
    """Return every series of a flight, one value per scrape."""
    times = range(0, int(flight.now) + AFTER, PERIOD)
    values = {}
    for role in ROLES:
        for n, readings in enumerate(scrapes(flight, role, times)):
            for name, value in samples(role, readings):
                values.setdefault(name, ["_"] * len(times))[n] = f"{value:.9g}"
    return [{"series": name, "values": " ".join(each)} for name, each in values.items()]


def seen_by(flight, role, until):
    """Return the records of a process up to a virtual time [s]."""
    kept = {"world": flight.of_world, "cloud": flight.of_cloud, "teleop": flight.teleop.events}
    until_ns = (flight.world if role == "world" else flight.cloud).clock.at(round(until * 1e9))
    return [record for record in kept[role] if record.stamp_ns <= until_ns]


def scrapes(flight, role, times):
    """Yield the readings of a process at each time [s]."""
    live, seen, sent = LiveMetrics(role), 0, 0
    for time in times:
        records = seen_by(flight, role, time)
        for record in records[seen:]:
            if isinstance(record, Counted) and record.name == "sent":
                if record.total < sent:  # a new process, which counts from 0
                    live = LiveMetrics(role)
                sent = record.total
            live.see([record])
        seen = len(records)
        ready = live.end is None or live.end.has_peer
        yield live.read() | {
            "cloudrc_build_info": {("1", role, "c"): 1.0},
            "cloudrc_ready": {(): float(ready)},
        }


def samples(role, readings):
    for name, reading in readings.items():
        if isinstance(reading, Histogram):
            yield f'{name}_sum{{instance="{role}"}}', reading.total
            yield f'{name}_count{{instance="{role}"}}', reading.cumulative()[-1]
            continue
        for labels, value in reading.items():
            named = zip(("instance", *METRICS[name].labels), (role, *labels), strict=True)
            inside = ",".join(f'{label}="{text}"' for label, text in named)
            yield f"{name}{{{inside}}}", value


def fired(flight, folder):
    """Return the alerts of the chart that a flight fires, evaluated by promtool."""
    expression = 'group by (alertname) (last_over_time(ALERTS{alertstate="firing"}[1d]))'
    test = {
        "interval": f"{PERIOD}s",
        "input_series": series(flight),
        "promql_expr_test": [{"expr": expression, "eval_time": f"{int(flight.now) + AFTER}s"}],
    }
    document = {"rule_files": ["rules.yaml"], "evaluation_interval": "5s", "tests": [test]}
    # All series of the flight belong to one release, so that no rule has to select.
    text = RULES.read_text().replace("{$pods}", "").replace("$pods,", "")
    (folder / "rules.yaml").write_text(text)
    (folder / "tests.yaml").write_text(yaml.safe_dump(document))
    # The test expects no sample, so promtool lists every sample as unexpected.
    command = ["promtool", "test", "rules", "tests.yaml"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    found = set(re.findall(r'{alertname="(\w+)"}', done.stderr))
    assert (done.returncode, bool(found)) in ((0, False), (1, True)), done.stderr
    return found


@pytest.fixture
def flights(monkeypatch):
    """All flights of a test."""
    if shutil.which("promtool") is None:
        pytest.skip("needs promtool (Debian package prometheus)")
    made: list[FaultRun] = []
    init = FaultRun.__init__

    def remember(self, *settings, **options):
        made.append(self)
        init(self, *settings, **options)

    monkeypatch.setattr(FaultRun, "__init__", remember)
    return made


@pytest.mark.parametrize("scenario", FLOWN)
def test_a_fault_fires_its_alerts_and_no_others(scenario, flights, tmp_path):
    scenario.run(1)
    found = [fired(flight, tmp_path) for flight in flights if flight.of_world]
    assert sorted(set[str]().union(*found)) == FIRES.get(scenario.id, [])


@pytest.mark.parametrize("profile", ["paper-p3", *nightly("paper-p1", "wifi")])
def test_a_clean_flight_fires_none(profile, flights, tmp_path):
    flight = FaultRun(Schedule(1, profile)).fly_mission()
    assert flight.mission.state == "done"
    assert flights == [flight]
    assert fired(flight, tmp_path) == set()
