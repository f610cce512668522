# SPDX-License-Identifier: Apache-2.0

"""Missions as Jobs of the chart, of its CronJob and of `cloudrc mission run`; each flies once."""

import pytest
import yaml

from cloudrc.config.load import load_experiment
from tests.chart.conftest import of_kind, render

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


def test_the_chart_kubectl_and_cloudrc_make_the_same_job():
    """In the volume of the recordings each of them leaves a report."""
    values = {"mission": {"enabled": True, "cronJob": {"enabled": True}}}
    objects = render({**values, "recordings": {"storage": "1Gi"}})
    (cron,) = of_kind(objects, "CronJob").values()
    job = yaml.safe_load(of_kind(objects, "ConfigMap")["mission-job"]["data"]["job.yaml"])
    specs = [*jobs({**values, "recordings": {"storage": "1Gi"}}), job, cron["spec"]["jobTemplate"]]
    for spec in (each["spec"] for each in specs):
        files, *_ = spec["template"]["spec"]["volumes"]
        assert files["name"] == "mission"
        del files["configMap"]
        assert spec == specs[0]["spec"]
    assert "--report=/var/lib/cloudrc" in str(job)


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
