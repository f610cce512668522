"""Prometheus finds the metrics by annotations, or by the objects of its operator."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml

from cloudrc.exposition import table
from cloudrc.exposition.table import METRICS, Kind
from tests.chart.conftest import CHART, OPERATOR, metrics_ports, of_kind, pod_specs, render
from tools.dashboards import draw, expressions, fetch

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


def series():
    """Return the names of all series; a histogram has the series bucket, sum and count."""
    parts = {Kind.HISTOGRAM: ("_bucket", "_sum", "_count")}
    return {name + part for name, one in METRICS.items() for part in parts.get(one.kind, ("",))}


def test_the_rules_use_existing_metrics_and_name_a_runbook():
    known = series() | RECORDED
    for rule in RULES:
        asked = re.findall(r"(?:\w+:)?cloudrc_\w+(?::\w+)?", rule["expr"])
        assert asked
        assert set(asked) <= known
        if "alert" in rule:
            assert rule["labels"]["severity"] in {"info", "warning", "critical"}
            runbook = rule["annotations"]["runbook"]
            assert runbook.endswith(f"README.md#{rule['alert'].lower()}")


def promtool_test(case):
    """Convert a case of alerts.yaml to the format of `promtool test rules`."""
    alerts = []
    for time, name, *fired in case.get("fires", ()):
        more, texts = ALERTS[name]["labels"], ALERTS[name]["annotations"]
        expected = [{"exp_labels": labels | more, "exp_annotations": texts} for labels in fired]
        alerts.append({"eval_time": time, "alertname": name, "exp_alerts": expected})
    samples = [
        {"labels": f'{{rule="{rule}",{labels}}}', "value": value}
        for rule, (value, labels) in case.get("recorded", {}).items()
    ]
    round_all = 'round(label_replace({__name__=~"pod:.+"}, "rule", "$1", "__name__", "(.+)"), 0.01)'
    asked = {"expr": round_all, "eval_time": "2m", "exp_samples": samples}
    return {
        "interval": "5s",
        "input_series": [{"series": k, "values": v} for k, v in case["series"].items()],
        "alert_rule_test": alerts,
        "promql_expr_test": [asked] if samples else [],
    }


@needs_promtool
def test_the_alerts_fire_when_they_should_and_only_then(tmp_path):
    cases = yaml.safe_load((Path(__file__).parent / "alerts.yaml").read_text())
    rows = [row for case in cases for row in case.get("fires", ())]
    assert {name for _, name, *fired in rows if fired} == ALERTS.keys(), "each alert has a case"
    assert cases[-1]["recorded"].keys() == RECORDED
    document = {"rule_files": [str(FILE)], "evaluation_interval": "5s"}
    (tmp_path / "tests.yaml").write_text(
        yaml.safe_dump(document | {"tests": list(map(promtool_test, cases))})
    )
    for words in (["check", "rules", FILE], ["test", "rules", tmp_path / "tests.yaml"]):
        done = subprocess.run(["promtool", *words], capture_output=True, text=True)
        assert "SUCCESS" in done.stdout, done.stdout + done.stderr


def dashboards(values=None, **where):
    """Render the ConfigMaps of dashboards, and the dashboards in them by name of the file."""
    objects = render({"dashboards": {"enabled": True, **(values or {})}}, **where)
    found = of_kind(objects, "ConfigMap").items()
    maps = [one for name, one in found if "grafana-" in name]
    texts = {name: text for one in maps for name, text in one["data"].items()}
    return maps, {name: json.loads(text) for name, text in texts.items()}


def queries():
    """Return each query of all dashboards, with the values that Grafana shows first."""
    found = dashboards()[1].values()
    return [
        query
        for one in found
        for panel in one["panels"]
        for query in expressions(one, panel).values()
    ]


def test_dashboards_are_optional_and_found_by_the_sidecar():
    assert not [name for name in of_kind(render(), "ConfigMap") if "grafana-" in name]
    values = {"labels": {"team": "robots"}, "annotations": {"grafana_folder": "lab"}}
    maps, shown = dashboards(values)
    topics = {path.stem for path in (CHART / "files" / "dashboards").iterdir()}
    assert topics == {"loop", "guard", "link", "resources", "missions"}
    assert len(maps) == len(shown) == len(topics)
    for one in maps:
        assert one["metadata"]["annotations"] == values["annotations"]
        wanted = values["labels"] | {"grafana_dashboard": "1"}
        assert one["metadata"]["labels"].items() > wanted.items()


def test_dashboards_of_several_releases_do_not_collide():
    """Grafana refuses two dashboards with one uid, or with one title in a folder."""
    places = (("demo", "lab"), ("demo", "class"), ("other", "lab"), ("d" * 53, "n" * 63))
    found = [item for r, n in places for item in dashboards(release=r, namespace=n)[1].items()]
    for distinct in (
        {name for name, _ in found},
        {one["uid"] for _, one in found},
        {one["title"] for _, one in found},
    ):
        assert len(distinct) == len(found)
    assert max(len(one["uid"]) for _, one in found) <= 40, "Grafana's limit"


def test_panels_have_their_places_queries_and_states():
    states = {}
    for one in dashboards()[1].values():
        taken = set()
        for panel in one["panels"]:
            at = panel["gridPos"]
            cells = {(at["x"] + i, at["y"] + j) for i in range(at["w"]) for j in range(at["h"])}
            assert not cells & taken
            assert max(x for x, _ in cells) < 24, "the width of Grafana's grid"
            taken |= cells
            assert len({target["refId"] for target in panel["targets"]}) == len(panel["targets"])
            assert panel["datasource"]["uid"] == "${datasource}"
            for mapping in panel["fieldConfig"]["defaults"].get("mappings", ()):
                options = mapping["options"]
                states[panel["title"]] = tuple(options[str(n)]["text"] for n in range(len(options)))
    assert states.pop("State of the guard") == table.GUARD_STATES
    assert states.pop("State of the mission") == table.MISSION_STATES
    assert states == {"The link is as asked": ("no", "yes")}


def test_panels_query_metrics_of_the_release_alone():
    assert len(queries()) > 40
    for query in queries():
        asked = set(re.findall(r"(\w+){", query))
        assert asked, query
        assert {name for name in asked if not name.startswith("process_")} <= series()
        for selector in re.findall(r"{(.*?)}", query):
            assert 'namespace=~"lab",pod=~"demo-cloudrc(-.*)?"' in selector


@needs_promtool
def test_promtool_accepts_the_queries_of_the_panels(tmp_path):
    rules = [{"record": f"query{n}", "expr": query} for n, query in enumerate(queries())]
    path = tmp_path / "rules.yaml"
    path.write_text(yaml.safe_dump({"groups": [{"name": "panels", "rules": rules}]}))
    done = subprocess.run(["promtool", "check", "rules", path], capture_output=True, text=True)
    assert f"SUCCESS: {len(rules)} rules" in done.stdout, done.stdout + done.stderr


def test_the_panels_are_drawn_without_grafana(tmp_path):
    def ask(query):
        labels = dict.fromkeys(("state", "cause", "limit"), "some")
        return [{"metric": labels, "values": [[0, "NaN"], [5, "1"]]}]

    guard = dashboards()[1]["lab-demo-cloudrc-guard.json"]
    draw([(guard, fetch(guard, ask, 300))], tmp_path / "panels.webp")
    assert (tmp_path / "panels.webp").read_bytes()[8:12] == b"WEBP"
