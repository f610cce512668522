"""The table of metrics: names by the rules, closed label sets, an entry for every count."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from cloudrc.exposition import table
from cloudrc.exposition.document import OPEN, QUERIES, page
from cloudrc.exposition.table import METRICS, Kind, Metric, of_role
from cloudrc.messages import GuardState
from cloudrc.teleop.wire import State

ROOT = Path(__file__).resolve().parents[2]
UNITS = ("seconds", "meters", "newtons", "meters_per_second", "radians_per_second")
NOT_DATAGRAMS = {
    "stalls",
    "missed_periods",
    "words_dropped",
    "horizon_clamped",
    "frozen",
    "start_refused",
    "held_seconds",
} | {f"limited_{limit}" for limit in table.LIMITS}


@pytest.mark.parametrize("metric", METRICS.values(), ids=lambda metric: metric.name)
def test_a_metric_keeps_the_rules(metric: Metric) -> None:
    assert re.fullmatch(r"cloudrc(_[a-z]+)+", metric.name)
    assert metric.name.endswith("_total") == (metric.kind is Kind.COUNTER)
    assert metric.meaning.endswith(".")
    assert set(metric.roles) <= set(table.ROLES)
    assert bool(metric.buckets) == (metric.kind is Kind.HISTOGRAM)
    assert list(metric.buckets) == sorted(metric.buckets)
    for name, values in metric.labels.items():
        assert values or name in OPEN, "a label has a closed set of values"


def test_delays_are_resolved_from_5_ms_to_1_s() -> None:
    assert (table.DELAY_BUCKETS[0], table.DELAY_BUCKETS[-1]) == (0.005, 1.0)


def test_the_names_that_others_use_exist() -> None:
    wanted = {
        "cloudrc_rtt_seconds": (),
        "cloudrc_uplink_delay_seconds": (),
        "cloudrc_downlink_delay_seconds": (),
        "cloudrc_delay_estimate_seconds": (),
        "cloudrc_prediction_error_meters": ("axis",),
        "cloudrc_pid_output": ("axis", "term"),
        "cloudrc_guard_state": (),
        "cloudrc_datagrams_total": ("direction", "outcome"),
        "cloudrc_real_time_factor": (),
        "cloudrc_link_info": ("shaper", "direction", "mode"),
        "cloudrc_build_info": ("version", "role", "config"),
    }
    assert {name: tuple(METRICS[name].labels) for name in wanted} == wanted


def test_states_are_numbered_as_their_enumerations() -> None:
    assert tuple(state.name.lower() for state in GuardState) == table.GUARD_STATES
    assert tuple(state.name.lower() for state in State) == table.MISSION_STATES


def test_the_shipped_bodies_are_known() -> None:
    scenes = (ROOT / "cloudrc" / "world" / "scenes").glob("*.xml")
    bodies = {
        name for scene in scenes for name in re.findall(r'<body name="(\w+)"', scene.read_text())
    }
    assert bodies
    assert {body.rstrip("_0123456789") for body in bodies} <= set(table.BODIES)


def test_every_count_of_the_ends_is_a_metric() -> None:
    found: set[str] = set()
    for part in ("world", "cloud", "tunnel"):
        for path in (ROOT / "cloudrc" / part).rglob("*.py"):
            text = path.read_text()
            found.update(re.findall(r'counts\["(\w+)"\]', text))
            found.update(re.findall(r'DecodeError\("(\w+)"\)', text))
            if path.name == "guard.py":
                found.update(re.findall(r'return "(\w+)"', text))
    assert {"sent", "malformed", "old_epoch", "stale", "missed_periods"} <= found
    assert found - set(table.OUTCOMES) - NOT_DATAGRAMS == set()


def test_every_role_has_the_metrics_of_a_process() -> None:
    for role in table.ROLES:
        names = {metric.name for metric in of_role(role)}
        assert {"cloudrc_build_info", "cloudrc_cpu_throttled_seconds_total"} <= names


def test_the_page_names_exactly_the_metrics_of_the_table() -> None:
    assert all(f"`{name}`" in page() for name in METRICS)
    for query in QUERIES.values():
        for name in re.findall(r"cloudrc_\w+", query):
            assert re.sub(r"(?<!_total)_(bucket|sum|count)$", "", name) in METRICS


def test_no_label_is_reserved_by_prometheus() -> None:
    """promtool refuses reserved labels outside of histograms and summaries."""
    labels = {label for metric in METRICS.values() for label in metric.labels}
    assert not labels & {"le", "quantile", "job", "instance", "namespace", "pod"}
