# SPDX-License-Identifier: Apache-2.0

"""Prometheus finds the metrics by annotations, or by the objects of its operator."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml

from cloudrc.results.exposition.table import METRICS, MetricKind
from tests.chart.conftest import CHART, OPERATOR, ROOT, notes, of_kind, render
from tools.dashboards import expressions

KINDS = {"PodMonitor", "PrometheusRule"}
needs_promtool = pytest.mark.skipif(
    shutil.which("promtool") is None, reason="Debian package prometheus"
)
FILE = CHART / "files" / "rules.yaml"
RULES = [rule for group in yaml.safe_load(FILE.read_text())["groups"] for rule in group["rules"]]
ALERTS = {rule["alert"]: rule for rule in RULES if "alert" in rule}
RECORDED = {rule["record"] for rule in RULES if "record" in rule}


def test_monitors_need_the_value_and_the_kind_or_force():
    def monitors(more, **where):
        values = {key: {"enabled": True, **more} for key in ("podMonitor", "prometheusRule")}
        objects = render({"metrics": values}, only="templates/monitoring/", **where)
        made = {thing["kind"] for thing in objects} & KINDS
        is_missed = values["podMonitor"]["enabled"] and not made
        assert ("no Prometheus operator" in notes({"metrics": values}, **where)) == is_missed
        return made

    assert monitors({"enabled": False}, apis=[OPERATOR]) == set()
    assert monitors({}) == set()
    assert monitors({}, apis=[OPERATOR]) == monitors({"force": True}) == KINDS


def series():
    """Return the names of all series; a histogram has the series bucket, sum and count."""
    parts = {MetricKind.HISTOGRAM: ("_bucket", "_sum", "_count")}
    return {name + part for name, one in METRICS.items() for part in parts.get(one.kind, ("",))}


def test_the_rules_use_existing_metrics_of_the_release_and_say_what_to_do():
    known = series() | RECORDED
    for rule in RULES:
        asked = re.findall(r"(?:\w+:)?cloudrc_\w+(?::\w+)?", rule["expr"])
        assert asked
        assert set(asked) <= known
        if "alert" in rule:
            assert rule["labels"]["severity"] in {"info", "warning", "critical"}
            assert rule["annotations"].keys() == {"summary", "description"}
        # Each series is selected by the release's pods, which the chart puts in.
        assert len(re.findall(r"[\w:]+\{\$pods[,}]", rule["expr"])) >= len(asked)


def in_release(labels):
    """Give the labels of alerts.yaml the namespace and the pod names of the release."""
    pod = labels.get("pod", "x")
    pod = f"demo-cloudrc-{pod if re.search('-[0-9]', pod) else 'world-' + pod}"
    return {**labels, "namespace": "lab", "pod": pod}


def labels_text(labels):
    return "{" + ",".join(f'{key}="{value}"' for key, value in labels.items()) + "}"


def labels_of(text):
    return dict(re.findall(r'(\w+)="(.*?)"', text))


def series_in_release(series):
    """Convert a series such as name{pod="world"} to one of the release."""
    name, _, text = series.partition("{")
    return name + labels_text(in_release(labels_of(text)))


def promtool_test(case):
    """Convert a case of alerts.yaml to the format of `promtool test rules`."""
    alerts = []
    for time, name, *fired in case.get("fires", ()):
        more = ALERTS[name]["labels"] | {"release": "demo"}
        expected = []
        for labels in fired:
            # A role that is absent has no pod.
            has_pod = "Absent" not in name or "pod" in labels
            seen = in_release(labels) if has_pod else {**labels, "namespace": "lab"}
            texts = {
                **ALERTS[name]["annotations"],
                "runbook_url": f"docs/on-call.md#{name.lower()}",
            }
            expected.append({"exp_labels": seen | more, "exp_annotations": texts})
        alerts.append({"eval_time": time, "alertname": name, "exp_alerts": expected})
    samples = []
    for rule, (value, labels) in case.get("recorded", {}).items():
        labels = in_release({"rule": rule, **labels_of(labels)})
        samples.append({"labels": labels_text(labels), "value": value})
    round_all = 'round(label_replace({__name__=~"pod:.+"}, "rule", "$1", "__name__", "(.+)"), 0.01)'
    asked = {"expr": round_all, "eval_time": "2m", "exp_samples": samples}
    return {
        "interval": "5s",
        "input_series": [
            {"series": series_in_release(k), "values": v} for k, v in case["series"].items()
        ],
        "alert_rule_test": alerts,
        "promql_expr_test": [asked] if samples else [],
    }


@needs_promtool
def test_the_alerts_fire_when_they_should_and_only_then(tmp_path):
    cases = yaml.safe_load((Path(__file__).parent / "alerts.yaml").read_text())
    rows = [row for case in cases for row in case.get("fires", ())]
    assert {name for _, name, *fired in rows if fired} == ALERTS.keys(), "each alert has a case"
    assert cases[-1]["recorded"].keys() == RECORDED
    cell = {"experiment": {"cell": {"rate_kbit": 500}}}
    for values in ({}, cell):
        chosen = [case for case in cases if case.get("cell", False) == bool(values)]
        promtool(tmp_path, rules(values), *map(promtool_test, chosen))


def rules(values, runbooks=""):
    """Render the rules of a release; `runbooks` is the address of a site."""
    on = {"runbooks": runbooks, "prometheusRule": {"enabled": True, "force": True}}
    (found,) = of_kind(render({**values, "metrics": on}), "PrometheusRule").values()
    return found["spec"]


@pytest.mark.parametrize("site", ["", "https://me.github.io", "https://me.github.io/cloudrc/"])
def test_each_alert_leads_to_its_section_of_the_page_on_call(site):
    page = ROOT / "docs" / "on-call.md"
    heads = re.findall(r"^## (\w+)$", page.read_text(), re.MULTILINE)
    (group,) = rules({}, site)["groups"]
    urls = [rule["annotations"]["runbook_url"] for rule in group["rules"] if "alert" in rule]
    place = f"{site.rstrip('/')}/on-call/" if site else page.relative_to(ROOT).as_posix()
    assert sorted(urls) == sorted(f"{place}#{head.lower()}" for head in heads)


def promtool(folder, rules, *tests):
    """Check rules, and test them."""
    (folder / "rules.yaml").write_text(yaml.safe_dump(rules))
    about = {"rule_files": ["rules.yaml"], "evaluation_interval": "5s"}
    (folder / "tests.yaml").write_text(yaml.safe_dump({**about, "tests": [*tests]}))
    said = ""
    for words in ("check rules rules.yaml", "test rules tests.yaml"):
        command = ["promtool", *words.split()]
        done = subprocess.run(command, capture_output=True, text=True, cwd=folder)
        assert "SUCCESS" in done.stdout, done.stdout + done.stderr
        said += done.stdout
    return said


def queries():
    """Return each query of all dashboards, with the values that Grafana shows first."""
    maps = of_kind(render("dashboards: {enabled: true}"), "ConfigMap").items()
    texts = [text for name, one in maps if "grafana-" in name for text in one["data"].values()]
    return [
        query
        for one in map(json.loads, texts)
        for panel in one["panels"]
        for query in expressions(one, panel).values()
    ]


def test_panels_query_metrics_of_the_release_alone():
    assert len(queries()) > 40
    for query in queries():
        asked = set(re.findall(r"(\w+){", query))
        assert asked, query
        assert {name for name in asked if not name.startswith("process_")} <= series()
        for selector in re.findall(r"{(.*?)}", query):
            assert 'namespace=~"lab",pod=~"demo-cloudrc-(world|cloud)-.*"' in selector


@needs_promtool
def test_promtool_accepts_the_queries_of_the_panels(tmp_path):
    rules = [{"record": f"query{n}", "expr": query} for n, query in enumerate(queries())]
    said = promtool(tmp_path, {"groups": [{"name": "panels", "rules": rules}]})
    assert f"SUCCESS: {len(rules)} rules" in said
