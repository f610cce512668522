"""Every metric that is found by its file keeps the contract of metrics, on any recording."""

from __future__ import annotations

from math import isfinite
from pathlib import Path

import pytest

from cloudrc import metrics, plugins
from cloudrc.config.schema import Criteria
from cloudrc.geometry.scene import load_scene
from cloudrc.metrics import Flight, measure_all
from cloudrc.record.columns import Recording
from cloudrc.record.topics import TOPICS
from tests.metrics.flights import DONE, ONE_PIPE, flown, paper, straight_flight

UNITS = {"s", "m", "m/s", "N", "1"}
NAMES = plugins.names("metrics")
WAYS = ("uplink", "downlink")
PROMISED = {
    *("duration", "contact_time", "min_clearance", "min_clearance_flight", "pipe_contacts"),
    *("tip_speed", "steady_contact_force", "waypoints_reached", "prediction_error_rms"),
    *("delay_estimate_error_rms", "rtt_mean", "rtt_p95", "uplink_delay_mean"),
    *("downlink_delay_mean", "loss_uplink", "loss_downlink", "tracking_rms_measured"),
    *("tracking_rms_estimated", "hold_count", "real_time_factor", "world_lateness_p99"),
    "cloud_lateness_p99",
}
"""Names that others build on.
Source: docs/reference/control.md, "Names that others use"."""


def flight_of(recording: Recording) -> Flight:
    return Flight(recording, Criteria(), 7, load_scene("pipes"))


def test_the_promised_names_are_there() -> None:
    assert set(NAMES) >= PROMISED


@pytest.mark.parametrize("name", NAMES)
def test_contract(name: str) -> None:
    metric = plugins.find("metrics", name)
    assert metric.UNIT in UNITS
    first_line = plugins.describe("metrics", name)
    assert first_line.endswith(".")
    assert first_line[0].isupper()
    value = metric.measure(flight_of(paper()[1]))
    assert value is None or (isinstance(value, float) and isfinite(value))


@pytest.mark.parametrize("name", NAMES)
def test_an_empty_recording_has_no_numbers(name: str) -> None:
    assert plugins.find("metrics", name).measure(flight_of(Recording.from_records([]))) is None


@pytest.mark.parametrize("lost", sorted(TOPICS))
def test_a_lost_topic_costs_no_other_number_its_life(lost: str) -> None:
    recording = straight_flight().recording
    rows = {name: recording._rows[name] for name in TOPICS if name != lost}
    _, notes = measure_all(Flight(Recording(rows), Criteria(), 1, ONE_PIPE))
    assert notes == []


def test_the_papers_flight_has_every_number_but_those_of_real_time_and_hovering() -> None:
    numbers, notes = measure_all(flight_of(paper()[1]))
    assert notes == []
    absent = set(NAMES) - set(numbers) - {"recorder_dropped"}
    assert absent == {
        *("real_time_factor", "world_slip", "world_lateness_p99", "cloud_lateness_p99"),
        "missed_periods",
        *(f"release_error_{share}_{way}" for share in ("p50", "p99", "p999") for way in WAYS),
        *(f"released_early_{way}" for way in WAYS),
        *(f"relay_{name}_{way}" for name in ("overflow", "stalled") for way in WAYS),
        *("steady_error_x", "steady_error_y", "steady_error_z"),
    }


def test_a_strangers_metric_that_raises_costs_only_its_own_number(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bodies = {
        "raises": "raise RuntimeError('no such column')",
        "infinite": "return float('inf')",
        "good": "return 3.0",
    }
    for name, body in bodies.items():
        text = f'"""A metric."""\nUNIT = "1"\ndef measure(flight):\n    {body}\n'
        (tmp_path / f"{name}.py").write_text(text)
    monkeypatch.setattr(metrics.plugins, "names", lambda kind: [str(p) for p in paths])
    paths = sorted(tmp_path.glob("*.py"))
    numbers, notes = measure_all(straight_flight())
    assert [number.value for number in numbers.values()] == [3.0]
    assert len(notes) == 2
    assert "raises.py failed: RuntimeError: no such column" in notes[1]
    assert "infinite.py gave inf: left out" in notes[0]


def test_a_flight_without_an_ending_lasts_as_long_as_its_recording() -> None:
    log = flown()
    log.cloud = [record for record in log.cloud if record.stamp_ns < DONE]
    assert log.flight().ending is None
    assert measure_all(log.flight())[0]["duration"].value == pytest.approx(15.0)
