# SPDX-License-Identifier: Apache-2.0

"""The table of metrics: names by the rules, closed label sets, an entry for every count."""

import re
from pathlib import Path

import pytest

from cloudrc.results.exposition import table
from cloudrc.results.exposition.table import METRICS, MetricKind
from cloudrc.teleop.wire import QUEUED, STATES
from tools.docs import OPEN

ROOT = Path(__file__).resolve().parents[3]


@pytest.mark.parametrize("metric", METRICS.values(), ids=lambda metric: metric.name)
def test_a_metric_keeps_the_rules(metric):
    assert re.fullmatch(r"cloudrc(_[a-z]+)+", metric.name)
    assert metric.name.endswith("_total") == (metric.kind is MetricKind.COUNTER)
    assert metric.meaning.endswith(".")
    assert set(metric.roles) <= set(table.ROLES)
    assert list(metric.buckets) == sorted(metric.buckets)
    for name, values in metric.labels.items():
        assert values or name in OPEN, "a label has a closed set of values"
    reserved = {"le", "quantile", "job", "instance", "namespace", "pod"}
    assert not metric.labels.keys() & reserved, "promtool refuses them"


def test_states_are_those_of_missions():
    assert {"idle", *STATES.values()} == {QUEUED, *table.MISSION_STATES}


def test_every_count_of_the_ends_is_a_metric():
    found: set[str] = set()
    for part in ("world", "cloud", "wire"):
        for path in (ROOT / "cloudrc" / part).rglob("*.py"):
            text = path.read_text()
            found.update(re.findall(r'counts\["(\w+)"\]', text))
            found.update(re.findall(r'DecodeError\("(\w+)"\)', text))
    assert {"sent", "malformed", "old_epoch", "stale", "missed_periods"} <= found
    known = {metric.counted for metric in METRICS.values()} | set(table.OUTCOMES)
    assert found - known - {f"limited_{limit}" for limit in table.LIMITS} == set()
