"""Prometheus finds the metrics by annotations, or by the objects of its operator."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml

from cloudrc.exposition.table import METRICS, Kind
from tests.chart.conftest import CHART, ROOT, Object, containers, of_kind, pod_specs, render

OPERATOR = "monitoring.coreos.com/v1"
BOTH: Object = {"metrics": {"podMonitor": {"enabled": True}, "prometheusRule": {"enabled": True}}}
KINDS = {"PodMonitor", "PrometheusRule"}
RULES = CHART / "files" / "rules.yaml"


def operated(objects: list[Object]) -> set[str]:
    return {thing["kind"] for thing in objects} & KINDS


def test_monitors_need_the_value_and_the_kind_or_force() -> None:
    assert operated(render(apis=[OPERATOR])) == set()
    assert operated(render(BOTH)) == set()
    objects = render(BOTH, apis=[OPERATOR])
    assert operated(objects) == KINDS
    forced = {key: {"enabled": True, "force": True} for key in ("podMonitor", "prometheusRule")}
    assert operated(render({"metrics": forced})) == KINDS
    (monitor,) = of_kind(objects, "PodMonitor").values()
    asked = {endpoint["port"] for endpoint in monitor["spec"]["podMetricsEndpoints"]}
    served = {
        port["name"]
        for end in ("world", "cloud")
        for container in containers(pod_specs(objects)[end]).values()
        for port in container["ports"]
        if port["name"].endswith("metrics")
    }
    assert asked == served


@pytest.mark.parametrize("wanted", [True, False])
def test_scrape_annotations_are_optional(wanted: bool) -> None:
    for thing in of_kind(render({"metrics": {"annotations": wanted}}), "Deployment").values():
        template = thing["spec"]["template"]
        found = {k: v for k, v in template["metadata"]["annotations"].items() if "prometheus" in k}
        assert bool(found) is wanted
        served = [
            str(p["containerPort"]) for c in template["spec"]["containers"] for p in c["ports"]
        ]
        assert not wanted or found["prometheus.io/scrape"] == "true"
        assert not wanted or found["prometheus.io/port"] in served


def test_the_rules_use_existing_metrics_and_name_a_runbook() -> None:
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
def test_the_alerts_fire_when_they_should_and_only_then(tmp_path: Path) -> None:
    shutil.copy(RULES, tmp_path)
    shutil.copy(ROOT / "tests" / "e2e" / "alerts.yaml", tmp_path)
    for words in (["check", "rules", RULES], ["test", "rules", tmp_path / "alerts.yaml"]):
        done = subprocess.run(["promtool", *words], capture_output=True, text=True)
        assert "SUCCESS" in done.stdout, done.stdout + done.stderr
