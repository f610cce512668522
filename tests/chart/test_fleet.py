# SPDX-License-Identifier: Apache-2.0

"""A fleet: StatefulSets, one cell, one Job; a single robot renders as before there were fleets."""

import json
import re
import shlex

import pytest
import yaml

from cloudrc.doors.cli.parser import build_parser
from tests.chart.conftest import CHART, containers, notes, of_kind, pod_specs, render
from tests.chart.test_render import OLDEST, helm

BEFORE = CHART.parents[1] / "tests" / "fixtures" / "charts" / "cloudrc-before-fleet.tgz"
CELL = {"cell": {"rate_kbit": 800}}
ON = {"enabled": True}
ALL = {
    "dashboards": ON,
    "mission": ON,
    "metrics": {"podMonitor": {**ON, "force": True}, "prometheusRule": {**ON, "force": True}},
}
FLEET = {**ALL, "robots": 3, "experiment": CELL}
ONBOARD = {**ALL, "experiment": {"cloud": {"place": "onboard"}}}


def manifests(chart, path):
    """Render with helm: (kind, name) -> text, without what is random or tells the version.

    Also without the limits of probes: that of the link has grown. And without the command
    `process`, which containers of earlier charts did not call.
    """
    flags = ("--namespace", "lab", "--kube-version", OLDEST, "--values", str(path))
    done = helm("template", "demo", str(chart), *flags)
    assert done.returncode == 0, done.stderr
    random = (
        r"(?m)^  (key|operator|reader): .*$|^ +(helm.sh/chart|timeoutSeconds|failureThreshold): .*$"
        r"|^ +- process\n"
    )
    texts = re.split(r"(?m)^---\n# Source: .*\n", re.sub(random, "", done.stdout))[1:]
    found = ((yaml.safe_load(each), each) for each in texts)
    return {(thing["kind"], thing["metadata"]["name"]): each for thing, each in found}


def test_one_robot_without_a_cell_renders_byte_by_byte_as_before_fleets(tmp_path):
    path = tmp_path / "values.yaml"
    values = {**ALL, "cloud": {"backgroundLoad": ON, "ros": ON}}
    path.write_text(json.dumps(values))
    before = manifests(BEFORE, path)
    del before["PrometheusRule", "demo-cloudrc"]  # the text of an alert has changed
    assert len(before) > 24
    path.write_text(json.dumps({**values, "robots": 1}))
    assert manifests(CHART, path).items() >= before.items()


def test_a_fleet_has_few_objects_one_set_of_rules_and_five_dashboards():
    objects = render({**FLEET, "robots": 50})
    sets = of_kind(objects, "StatefulSet")
    robots = {name: one["spec"]["replicas"] for name, one in sets.items()}
    assert robots == {"world": 50, "cloud": 50, "cell": 1}
    # Kubernetes adds an EndpointSlice per Service and family and a revision per set, Helm a Secret.
    assert len(objects) + 2 * len(of_kind(objects, "Service")) + len(sets) + 1 <= 60
    (rules,) = of_kind(objects, "PrometheusRule").values()
    assert sum(len(group["rules"]) for group in rules["spec"]["groups"]) == 23
    maps = [name for name in of_kind(objects, "ConfigMap") if name.startswith("grafana-")]
    assert len(maps) == 5


def test_every_tunnel_of_a_fleet_goes_through_the_cell_alone():
    objects = render(FLEET)
    pods, policies = pod_specs(objects), of_kind(objects, "NetworkPolicy")
    for end, port in (("world", 7400), ("cloud", 8400)):
        assert "link" not in containers(pods[end])
        arguments = containers(pods[end])[end]["args"]
        assert {f"--peer=demo-cloudrc-cell:{port}", "--robot=$(ROBOT)"} <= {*arguments}
        spec = policies[end]["spec"]
        for way, rules in (("from", spec["ingress"]), ("to", spec["egress"])):
            tunnel = [r for r in rules if {"UDP"} == {p["protocol"] for p in r["ports"]}]
            (rule,) = (each for each in tunnel if each["ports"][0]["port"] != 53)
            (peer,) = rule[way]
            labels = peer["podSelector"]["matchLabels"]
            assert labels["app.kubernetes.io/component"] == "cell"


def test_one_indexed_job_flies_each_robot_through_its_own_api():
    (job,) = of_kind(render(FLEET), "Job").values()
    spec = job["spec"]
    assert (spec["completionMode"], spec["completions"], spec["parallelism"]) == ("Indexed", 3, 3)
    assert (spec["backoffLimitPerIndex"], spec.get("backoffLimit")) == (0, None)
    host = "http://demo-cloudrc-cloud-$(JOB_COMPLETION_INDEX).demo-cloudrc-cloud:8080"
    assert f"--api={host}" in spec["template"]["spec"]["containers"][0]["args"]


def test_on_board_the_controller_is_in_the_world_pod_without_a_link():
    objects = render({**ONBOARD, "cloud": {"resources": {"limits": {"cpu": "200m"}}}})
    assert of_kind(objects, "StatefulSet").keys() == {"world"}
    assert "cloud" not in of_kind(objects, "NetworkPolicy")
    found = containers(pod_specs(objects)["world"])
    assert [*found] == ["world", "cloud", "teleop"]
    assert found["cloud"]["resources"]["limits"]["cpu"] == "200m"
    (experiment,) = (
        m["data"] for n, m in of_kind(objects, "ConfigMap").items() if n == "experiment"
    )
    for end, other in (("world", "cloud"), ("cloud", "world")):
        listens = next(word for word in found[other]["args"] if word.startswith("--listen="))
        assert listens == f"--listen={experiment[f'route-{end}']}"


def test_prometheus_tells_robots_and_releases_apart():
    objects = render(FLEET)
    (monitor,) = of_kind(objects, "PodMonitor").values()
    for each in monitor["spec"]["podMetricsEndpoints"]:
        robot, release = each["relabelings"]
        assert robot["targetLabel"] == "robot"
        for text, number in (("world;7", "7"), ("cloud;0", "0"), ("cell;0", None)):
            found = re.fullmatch(robot["regex"], text)
            assert (found and found[1]) == number
        assert release == {"targetLabel": "release", "replacement": "demo"}
    data = of_kind(objects, "ConfigMap")["grafana-link"]["data"]
    board = json.loads(next(iter(data.values())))
    names = [variable["name"] for variable in board["templating"]["list"]]
    assert names == ["datasource", "namespace", "release", "robot"]
    assert any("worst and median robot" in panel["title"] for panel in board["panels"])
    for panel in board["panels"]:
        for target in panel["targets"]:
            selectors = re.findall(r"{(.*?)}", target["expr"])
            assert all('release=~"$release"' in each for each in selectors)
            # The cell serves all robots, and "worst" means of all: whichever robot is chosen.
            of_all = "cell" in target["expr"] or "worst" in panel["title"]
            assert all(('robot=~"$robot"' in each) != of_all for each in selectors)


def test_each_container_that_reads_the_experiment_knows_the_robots_number():
    values = {**FLEET, "console": ON, "ros": ON, "cloud": {"ros": {**ON, "launch": ["true"]}}}
    found = [each for pod in pod_specs(render(values)).values() for each in pod["containers"]]
    readers = {
        one["name"]: one
        for one in found
        if "--config=/etc/cloudrc/experiment.yaml" in one.get("args", []) and one["name"] != "cell"
    }
    assert readers.keys() == {"world", "cloud", "teleop", "ros", "bridge", "console"}
    for one in readers.values():
        assert "--robot=$(ROBOT)" in one["args"]
        assert "ROBOT" in [each["name"] for each in one["env"]]


def test_more_robots_restart_nothing():
    def annotations(robots):
        found = of_kind(render({**FLEET, "robots": robots}), "StatefulSet").values()
        return [one["spec"]["template"]["metadata"]["annotations"] for one in found]

    assert annotations(3) == annotations(4)


def test_queue_and_scheduler_are_those_of_the_values():
    given = {"queueName": "lab", "schedulerName": "volcano"}
    objects = render({**FLEET, "scheduling": given})
    assert {pod["schedulerName"] for pod in pod_specs(objects).values()} == {"volcano"}
    for kind, count in (("StatefulSet", 3), ("Job", 1)):
        labels = [one["metadata"]["labels"] for one in of_kind(objects, kind).values()]
        assert [each["kueue.x-k8s.io/queue-name"] for each in labels] == ["lab"] * count
    patrol = {"scheduling": given, "mission": {"cronJob": {"enabled": True}}}
    (cron,) = of_kind(render(patrol), "CronJob").values()
    labels = cron["spec"]["jobTemplate"]["metadata"]["labels"]
    assert labels["kueue.x-k8s.io/queue-name"] == "lab"
    template = of_kind(objects, "ConfigMap")["mission-job"]["data"]["job.yaml"]
    assert yaml.safe_load(template)["metadata"]["labels"] == {"kueue.x-k8s.io/queue-name": "lab"}


@pytest.mark.parametrize(
    ("experiment", "words"),
    [
        ({**CELL, "fleet": {"only": 0}}, "leave it out, or set robots=1"),
        ({**CELL, "cloud": {"place": "onboard"}}, "leave one out"),
    ],
)
def test_a_fleet_that_cannot_fly_is_refused(experiment, words):
    with pytest.raises(Exception, match=words):
        render({"robots": 2, "experiment": experiment})


def test_the_notes_of_a_fleet_are_commands_for_it():
    text = notes(FLEET, release="flight")
    assert "has 3 robots behind one cell" in text
    wait, fly, logs = (shlex.split(line) for line in text.splitlines() if line.startswith("  "))
    assert wait[wait.index("--selector") + 1].startswith("app.kubernetes.io/instance=flight,")
    assert build_parser([fly[1]]).parse_args(fly[1:]).release == "flight"
    assert "statefulset/flight-cloudrc-cell" in logs
