"""Missions as Jobs of the chart, of the examples and of `helm test`; each flies once."""

import copy

import pytest
import yaml

from cloudrc.config.load import load_experiment
from tests.chart.conftest import CHART, of_kind, render

EXAMPLES = {
    name: list(yaml.safe_load_all((CHART / "examples" / f"{name}.yaml").read_text()))
    for name in ("mission-job", "mission-paper")
}
ENABLED = "mission: {enabled: true}"


def load(mission):
    return load_experiment("paper", [f"mission={mission}"], flown=True).mission


def jobs(values=None, **where):
    return list(of_kind(render(values, **where), "Job").values())


@pytest.mark.parametrize(
    ("values", "name"),
    [
        ("{mission: {enabled: true}, experiment: {mission: hover}}", "hover"),
        ("mission: {enabled: true, plan: hover}", "hover"),
        ("mission: {enabled: true, plan: {start: here, waypoints: [{position_m: [0, 0, 1]}]}}", ""),
    ],
)
def test_the_plan_defaults_to_the_experiments_mission(values, name, tmp_path):
    objects = render(values)
    (job,) = of_kind(objects, "Job").values()
    config = job["spec"]["template"]["spec"]["volumes"][0]["configMap"]["name"]
    (data,) = (t["data"] for t in objects if t["metadata"]["name"] == config and "data" in t)
    (tmp_path / "mission.yaml").write_text(data["mission.yaml"])
    mission = load(tmp_path / "mission.yaml")
    assert mission == load(name) if name else mission.start == "here"


def test_only_another_mission_makes_another_job():
    """A Job is immutable: with the same name, an upgrade with a new plan would fail."""
    other = "mission: {enabled: true, plan: hover}"
    given = (ENABLED, ENABLED, other, "{mission: {enabled: true}, image: {tag: '9'}}")
    names = [job["metadata"]["name"] for values in given for job in jobs(values)]
    assert names[0] == names[1]
    assert len(set(names)) == 3


def test_the_chart_makes_the_job_of_the_example():
    """`cloudrc mission run` also uses the Job of the example."""
    found = (*jobs(ENABLED, release="cloudrc"), EXAMPLES["mission-job"][1])
    ours, theirs = (job["spec"]["template"]["spec"] for job in copy.deepcopy(found))
    for pod in (ours, theirs):
        (container,) = pod["containers"]
        key = container["env"][0].pop("name")
        container["args"] = sorted(word.replace(key, "KEY") for word in container["args"])
        pod["volumes"][0]["configMap"] = {}
        pod.pop("serviceAccountName", None)
    assert ours == theirs


def test_a_suspended_cron_job_is_the_template_of_jobs():
    """`kubectl create job --from=cronjob/NAME-mission` copies labels and spec of the template."""
    objects = render("mission: {cronJob: {enabled: true}}", release="d" * 53)
    (cron,) = of_kind(objects, "CronJob").values()
    assert cron["spec"]["suspend"]
    assert len(cron["metadata"]["name"]) <= 52
    template = cron["spec"]["jobTemplate"]
    assert template["metadata"]["labels"]["app.kubernetes.io/component"] == "mission"
    volume = template["spec"]["template"]["spec"]["volumes"][0]
    configs = [thing["metadata"]["name"] for thing in objects if thing["kind"] == "ConfigMap"]
    assert volume["configMap"]["name"] == cron["metadata"]["name"]
    assert cron["metadata"]["name"] in configs
