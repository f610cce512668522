"""Every shipped metric keeps the contract of metrics, on any recording."""

from __future__ import annotations

from math import isfinite

import pytest

from cloudrc.config.schema import Criteria
from cloudrc.geometry.scene import load_scene
from cloudrc.metrics import SHIPPED, Flight, control, flight, link, measure_all, mission
from cloudrc.record.columns import Recording
from cloudrc.record.topics import TOPICS
from tests.metrics.conftest import DONE, ONE_PIPE, flown, paper, straight_flight

UNITS = {"s", "m", "m/s", "N", "1"}
WAYS = ("uplink", "downlink")
PROMISED = {
    *("duration", "contact_time", "min_clearance", "min_clearance_flight", "pipe_contacts"),
    *("tip_speed", "steady_contact_force", "waypoints_reached", "prediction_error_rms"),
    *("delay_estimate_error_rms", "rtt_mean", "rtt_p95", "uplink_delay_mean"),
    *("downlink_delay_mean", "loss_uplink", "loss_downlink", "tracking_rms_measured"),
    *("tracking_rms_estimated", "hold_count", "real_time_factor", "world_lateness_p99"),
    "cloud_lateness_p99",
}
"""Names that others use.
Source: docs/reference/control.md, "Names that others use"."""


def flight_of(recording: Recording) -> Flight:
    return Flight(recording, Criteria(), 7, load_scene("pipes"))


def test_the_promised_names_are_there() -> None:
    assert set(SHIPPED) >= PROMISED


def test_no_two_rows_have_one_name() -> None:
    assert len(SHIPPED) == sum(len(table.METRICS) for table in (flight, control, link, mission))


@pytest.mark.parametrize("name", SHIPPED)
def test_contract(name: str) -> None:
    metric = SHIPPED[name]
    assert metric.unit in UNITS
    assert metric.meaning.endswith(".")
    assert metric.meaning[0].isupper()
    value = metric.measure(flight_of(paper()[1]))
    assert value is None or (isinstance(value, float) and isfinite(value))


@pytest.mark.parametrize("name", SHIPPED)
def test_an_empty_recording_has_no_numbers(name: str) -> None:
    assert SHIPPED[name].measure(flight_of(Recording.from_records([]))) is None


@pytest.mark.parametrize("lost", sorted(TOPICS))
def test_a_missing_topic_makes_no_metric_fail(lost: str) -> None:
    recording = straight_flight().recording
    rows = {name: recording._rows[name] for name in TOPICS if name != lost}
    _, notes = measure_all(Flight(Recording(rows), Criteria(), 1, ONE_PIPE))
    assert notes == []


def test_the_paper_flight_has_all_numbers_of_virtual_flight() -> None:
    numbers, notes = measure_all(flight_of(paper()[1]))
    assert notes == []
    assert list(numbers) == sorted(numbers)
    absent = set(SHIPPED) - set(numbers) - {"recorder_dropped"}
    assert absent == {
        *("real_time_factor", "world_slip", "world_lateness_p99", "cloud_lateness_p99"),
        "missed_periods",
        *(f"release_error_{share}_{way}" for share in ("p50", "p99", "p999") for way in WAYS),
        *(f"released_early_{way}" for way in WAYS),
        *(f"relay_{name}_{way}" for name in ("overflow", "stalled") for way in WAYS),
        *("steady_error_x", "steady_error_y", "steady_error_z"),
    }


def test_a_flight_without_an_end_lasts_as_its_recording() -> None:
    log = flown()
    log.cloud = [record for record in log.cloud if record.stamp_ns < DONE]
    assert log.flight().ending is None
    assert measure_all(log.flight())[0]["duration"].value == pytest.approx(15.0)
