"""The text for Prometheus is valid and small; unknown values are absent."""

from __future__ import annotations

import shutil
import subprocess
import time

import pytest
from prometheus_client.parser import text_string_to_metric_families

from cloudrc import __version__
from cloudrc.config.load import load_experiment
from cloudrc.drivers.exporter import Exporter
from cloudrc.exposition.table import (
    BODIES,
    DIRECTIONS,
    ENDS,
    LINK_OUTCOMES,
    METRICS,
    ROLES,
    Kind,
    of_role,
)
from cloudrc.link.netem import Steps
from cloudrc.link.relay import Recent, ReleaseErrors
from cloudrc.messages import ZERO
from cloudrc.records import (
    Contact,
    Control,
    Counted,
    Lateness,
    LinkChecked,
    MissionEvent,
    Record,
    TelemetrySent,
)
from tests.drivers.conftest import here
from tests.flights.conftest import records

Flight = dict[str, list[Record]]
PERIODS = (TelemetrySent, Control)


@pytest.fixture(scope="module")
def flight() -> Flight:
    """The records of a flight with real-time wakes, and those of the other roles."""
    both = records(load_experiment("hover", ["link.profile=paper-p3"]))
    seen: Flight = {}
    for end, of_end in zip(ENDS, both, strict=True):
        seen[end] = []
        for record in of_end:
            seen[end].append(record)
            if isinstance(record, PERIODS):
                seen[end].append(Lateness(record.stamp_ns, end, 80e-6, 300e-6, 0))
    seen["world"] += [Contact(0, body, ZERO, ZERO, ZERO, True) for body in BODIES]
    for end in ENDS:
        way = DIRECTIONS[ENDS.index(end) - 1]
        seen[end] += [
            LinkChecked(9, way == "uplink", name, 0.1, 0.1, 0.0, 0.2, "ok", 3000)
            for name in ("mean", "deviation", "loss")
        ]
    seen["teleop"] = [r for r in seen["cloud"] if isinstance(r, MissionEvent)]
    errors = ReleaseErrors()
    for late_ns in (3_000, 30_000, 300_000, 3_000_000, 300_000_000):
        errors.observe(late_ns)
    counts = dict.fromkeys(LINK_OUTCOMES, 5) | Recent().counts(errors) | {"restored": 1}
    seen["link"] = [Counted(0, "link", name, total) for name, total in counts.items()]
    steps = Steps()
    steps.note(1_000_000, 0)
    seen["link"] += [Counted(0, "link", name, total) for name, total in steps.counts().items()]
    return seen


def exporter(role: str, flight: Flight, *, missions: bool = True) -> Exporter:
    made = Exporter(role, missions=missions)
    made.see(flight[role])
    if role in ENDS:
        made.recording(lambda: 0.3)
    if role == "link":
        made.shaped("relay", "uplink", "auto")
        made.shaped("relay", "downlink", "auto")
        made.asked("uplink", 0.045)
    return made


def series(text: str) -> list[str]:
    return [line for line in text.splitlines() if not line.startswith("#")]


@pytest.mark.parametrize("role", ROLES)
def test_promtool_finds_nothing_to_say(role: str, flight: Flight) -> None:
    if shutil.which("promtool") is None:
        pytest.skip("promtool is missing: apt-get install prometheus")
    command = ["promtool", "check", "metrics"]
    done = subprocess.run(
        command, input=exporter(role, flight).text(), capture_output=True, text=True
    )
    assert (done.returncode, done.stdout + done.stderr) == (0, "")


@pytest.mark.parametrize("role", ROLES)
def test_a_flight_shows_every_metric_of_its_role_and_no_other(role: str, flight: Flight) -> None:
    families = text_string_to_metric_families(exporter(role, flight).text())
    found = {family.name + "_total" * (family.type == "counter") for family in families}
    optional = {name for name in METRICS if "_cpu_" in name}  # only if the kernel counts it
    expected = {metric.name for metric in of_role(role)}
    assert {
        name for name in found if not name.startswith("process_")
    } | optional == expected | optional


@pytest.mark.parametrize("role", ROLES)
def test_labels_keep_to_their_sets(role: str, flight: Flight) -> None:
    for family in text_string_to_metric_families(exporter(role, flight).text()):
        for sample in family.samples:
            metric = METRICS.get(sample.name)
            if metric is not None and metric.kind is not Kind.HISTOGRAM:
                assert set(sample.labels) == set(metric.labels)
                for name, value in sample.labels.items():
                    assert value in (metric.labels[name] or (__version__, ""))


@pytest.mark.parametrize("pod", [("world", "link"), ("cloud", "teleop", "link")])
def test_a_pod_has_less_than_200_series(pod: tuple[str, ...], flight: Flight) -> None:
    """Only teleop exports the metrics of missions."""
    made = [exporter(role, flight, missions=role != "cloud") for role in pod]
    assert sum(len(series(one.text())) for one in made) < 200


def test_a_cloud_whose_missions_are_teleops_tells_of_none(flight: Flight) -> None:
    shown = {alone: exporter("cloud", flight, missions=alone).text() for alone in (True, False)}
    assert ["cloudrc_mission_state" in text for text in shown.values()] == [True, False]
    assert "cloudrc_rtt_seconds_count" in shown[False]


@pytest.mark.promise("unknown-is-absent")
def test_the_sync_age_is_absent_until_it_is_known() -> None:
    ages: list[float | None] = [None, 0.25]
    world = Exporter("world")
    assert "sync_age" not in world.text()
    world.recording(lambda: ages.pop(0))
    assert "sync_age" not in world.text()
    assert "cloudrc_recorder_sync_age_seconds 0.25" in world.text()


def test_unresolved_names_are_counted_and_are_no_sign_of_life() -> None:
    link = Exporter("link")
    assert "cloudrc_dns_errors_total 0.0" in link.text()
    link.unresolved(7)
    assert "cloudrc_dns_errors_total 7.0" in link.text()
    assert link._seen_at is None


@pytest.mark.parametrize("role", ROLES)
def test_nothing_says_when_it_was_created(role: str, flight: Flight) -> None:
    assert "_created" not in exporter(role, flight).text()


def test_the_build_is_named_once(flight: Flight) -> None:
    world = exporter("world", flight)
    for config in ("", "0123456789ab"):
        lines = [line for line in series(world.text()) if "build_info" in line]
        text = f'config="{config}",role="world",version="{__version__}"'
        assert lines == [f"cloudrc_build_info{{{text}}} 1.0"]
        world.runs("0123456789ab" + "f" * 52)


def test_a_shaper_takes_the_place_of_the_one_before() -> None:
    link = Exporter("link")
    link.shaped("relay", "uplink", "auto")
    link.shaped("netem", "uplink", "auto")
    lines = [line for line in series(link.text()) if "link_info" in line]
    assert lines == ['cloudrc_link_info{direction="uplink",mode="auto",shaper="netem"} 1.0']


@pytest.mark.full
@pytest.mark.parametrize("end", ENDS)
def test_a_record_costs_less_than_a_microsecond(end: str, flight: Flight) -> None:
    """The fastest of several repeats counts, since the machine may be busy."""
    chunks = [flight[end][i : i + 4] for i in range(0, len(flight[end]), 4)]
    least = float("inf")
    for _ in range(15):
        made = Exporter(end)
        began = time.process_time()
        for chunk in chunks:
            made.see(chunk)
        least = min(least, time.process_time() - began)
    assert least / len(flight[end]) < 1e-6 * here()
