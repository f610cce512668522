"""Prometheus finds the metrics by annotations, or by the objects of its operator."""

import re
import shutil
import subprocess

import pytest
import yaml

from cloudrc.exposition.table import METRICS, Kind
from tests.chart.conftest import CHART, OPERATOR, ROOT, metrics_ports, of_kind, pod_specs, render

KINDS = {"PodMonitor", "PrometheusRule"}
RULES = CHART / "files" / "rules.yaml"


def test_monitors_need_the_value_and_the_kind_or_force():
    def monitors(more, **where):
        values = {key: {"enabled": True, **more} for key in ("podMonitor", "prometheusRule")}
        return {thing["kind"] for thing in render({"metrics": values}, **where)} & KINDS

    assert monitors({"enabled": False}, apis=[OPERATOR]) == set()
    assert monitors({}) == set()
    assert monitors({}, apis=[OPERATOR]) == monitors({"force": True}) == KINDS
    objects = render({"metrics": {"podMonitor": {"enabled": True}}}, apis=[OPERATOR])
    (monitor,) = of_kind(objects, "PodMonitor").values()
    asked = {endpoint["port"] for endpoint in monitor["spec"]["podMetricsEndpoints"]}
    pods = pod_specs(objects)
    assert asked == {name for end in ("world", "cloud") for name in metrics_ports(pods[end])}


@pytest.mark.parametrize("wanted", [True, False])
def test_scrape_annotations_are_optional(wanted):
    for thing in of_kind(render({"metrics": {"annotations": wanted}}), "Deployment").values():
        template = thing["spec"]["template"]
        found = {k: v for k, v in template["metadata"]["annotations"].items() if "prometheus" in k}
        assert bool(found) is wanted
        if wanted:
            assert found["prometheus.io/scrape"] == "true"
            assert int(found["prometheus.io/port"]) in metrics_ports(template["spec"]).values()


def test_the_rules_use_existing_metrics_and_name_a_runbook():
    groups = yaml.safe_load(RULES.read_text())["groups"]
    rules = [rule for group in groups for rule in group["rules"]]
    known = set(METRICS) | {rule["record"] for rule in rules if "record" in rule}
    for name, metric in METRICS.items():
        if metric.kind is Kind.HISTOGRAM:
            known |= {f"{name}_{part}" for part in ("bucket", "sum", "count")}
    for rule in rules:
        asked = re.findall(r"(?:\w+:)?cloudrc_\w+(?::\w+)?", rule["expr"])
        assert asked
        assert set(asked) <= known
        if "alert" in rule:
            assert rule["labels"]["severity"] in {"info", "warning", "critical"}
            runbook = rule["annotations"]["runbook"]
            assert runbook.endswith(f"README.md#{rule['alert'].lower()}")


@pytest.mark.skipif(shutil.which("promtool") is None, reason="Debian package prometheus")
def test_the_alerts_fire_when_they_should_and_only_then(tmp_path):
    shutil.copy(RULES, tmp_path)
    shutil.copy(ROOT / "tests" / "e2e" / "alerts.yaml", tmp_path)
    for words in (["check", "rules", RULES], ["test", "rules", tmp_path / "alerts.yaml"]):
        done = subprocess.run(["promtool", *words], capture_output=True, text=True)
        assert "SUCCESS" in done.stdout, done.stdout + done.stderr
