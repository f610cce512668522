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


def test_monitors_need_the_value_and_the_kind() -> None:
    assert operated(render()) == set()
    assert operated(render(apis=[OPERATOR])) == set()
    assert operated(render(BOTH)) == set()
    assert operated(render(BOTH, apis=[OPERATOR])) == KINDS


def test_monitors_can_be_forced() -> None:
    forced = {key: {"enabled": True, "force": True} for key in ("podMonitor", "prometheusRule")}
    assert operated(render({"metrics": forced})) == KINDS


def test_the_monitor_has_the_ports_of_the_pods() -> None:
    (monitor,) = of_kind(render(BOTH, apis=[OPERATOR]), "PodMonitor").values()
    asked = {endpoint["port"] for endpoint in monitor["spec"]["podMetricsEndpoints"]}
    served = {
        port["name"]
        for end in ("world", "cloud")
        for container in containers(pod_specs(render())[end]).values()
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
        if wanted:
            port = int(found["prometheus.io/port"])
            assert found["prometheus.io/scrape"] == "true"
            served = [
                p["containerPort"] for c in template["spec"]["containers"] for p in c["ports"]
            ]
            assert port in served


def rules() -> list[Object]:
    groups = yaml.safe_load(RULES.read_text())["groups"]
    return [rule for group in groups for rule in group["rules"]]


def test_the_rules_use_existing_metrics() -> None:
    known = set(METRICS) | {rule["record"] for rule in rules() if "record" in rule}
    for name, metric in METRICS.items():
        if metric.kind is Kind.HISTOGRAM:
            known |= {f"{name}_{part}" for part in ("bucket", "sum", "count")}
    for rule in rules():
        asked = re.findall(r"(?:\w+:)?cloudrc_\w+(?::\w+)?", rule["expr"])
        assert asked
        assert set(asked) <= known


def test_alerts_have_severity_summary_and_runbook() -> None:
    for rule in rules():
        if "record" in rule:
            assert rule["record"].count(":") == 2  # level:metric:operation
            continue
        assert rule["labels"]["severity"] in {"info", "warning", "critical"}
        assert rule["annotations"]["summary"].endswith(".")
        assert rule["annotations"]["runbook"].endswith(f"README.md#{rule['alert'].lower()}")


def promtool(*words: object) -> str:
    if shutil.which("promtool") is None:
        pytest.skip("no promtool here (Debian package prometheus)")
    done = subprocess.run(["promtool", *map(str, words)], capture_output=True, text=True)
    return done.stdout + done.stderr


def test_promtool_accepts_the_rules() -> None:
    assert "SUCCESS" in promtool("check", "rules", RULES)


def test_the_alerts_fire_when_they_should_and_only_then(tmp_path: Path) -> None:
    shutil.copy(RULES, tmp_path)
    shutil.copy(ROOT / "tests" / "e2e" / "alerts.yaml", tmp_path)
    said = promtool("test", "rules", tmp_path / "alerts.yaml")
    assert "SUCCESS" in said, said
