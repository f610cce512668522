"""Names, labels, selectors, images, arguments and notes fit together."""

import re
import shlex

import pytest

import cloudrc
from cloudrc.cli.parser import build_parser
from tests.chart.conftest import (
    CHART,
    METADATA,
    containers,
    notes,
    of_kind,
    pod_specs,
    render,
    values_of,
)

KEYS = ("name", "instance", "component", "version", "part-of", "managed-by")
LABELS = {f"app.kubernetes.io/{key}" for key in KEYS} | {"helm.sh/chart"}
SELECTORS = {f"app.kubernetes.io/{key}" for key in KEYS[:3]}


def test_objects_have_the_labels_that_selectors_need():
    assert METADATA["version"] == METADATA["appVersion"] == cloudrc.__version__
    objects = render(values_of(CHART / "ci" / "everything-values.yaml"))
    for thing in objects:
        assert thing["metadata"]["labels"].keys() >= LABELS, thing["metadata"]["name"]
    deployments = of_kind(objects, "Deployment").values()
    pods = [thing["spec"]["template"]["metadata"]["labels"] for thing in deployments]
    for labels in pods:  # a new version of the chart alone restarts no pod
        assert not labels.keys() & {"helm.sh/chart", "app.kubernetes.io/version"}
    for thing in (*deployments, *of_kind(objects, "Service").values()):
        selector = thing["spec"]["selector"]
        selector = selector.get("matchLabels", selector)
        assert selector.keys() == SELECTORS
        assert sum(selector.items() <= labels.items() for labels in pods) == 1


@pytest.mark.parametrize(
    ("release", "values", "name"),
    [
        ("my-cloudrc", {}, "my-cloudrc-world"),
        ("1rel", {"fullnameOverride": "robot"}, "robot-world"),
        ("d" * 53, {}, "d" * 46 + "-world"),
    ],
)
def test_names_follow_release_and_override(release, values, name):
    objects = render({**values, "mission": {"enabled": True}}, release=release)
    assert name in {thing["metadata"]["name"] for thing in objects}
    assert max(len(thing["metadata"]["name"]) for thing in objects) <= 63


@pytest.mark.parametrize("release", ["1rel", "my.rel"])
def test_an_invalid_name_is_refused(release):
    with pytest.raises(Exception, match=f"the name '{release}-cloudrc' .* set fullnameOverride"):
        render(release=release)


def test_a_chart_may_contain_this_one_several_times_under_aliases():
    on = {"enabled": True}
    values = {**on, "mission": on, "dashboards": on}
    for release, *aliases in (("b-lab", "cloudrc", "robot_A", "b"), ("d" * 53, "robotA", "robotB")):
        robots = [render(values, release=release, alias=alias) for alias in aliases]
        named = [{(x["kind"], x["metadata"]["name"]) for x in objects} for objects in robots]
        assert len(set.union(*named)) == sum(map(len, named))
        pods = [
            labels
            for objects in robots
            for x in objects
            if (labels := x.get("spec", {}).get("template", {}).get("metadata", {}).get("labels"))
        ]
        assert len({labels["app.kubernetes.io/instance"] for labels in pods}) == len(robots)
        for service in (x for o in robots for x in o if x["kind"] == "Service"):
            selector = service["spec"]["selector"].items()
            assert sum(selector <= labels.items() for labels in pods) == 1


def test_annotations_and_placement_of_the_user_are_used():
    where = {
        "nodeSelector": {"disk": "fast"},
        "tolerations": [{"key": "lab", "operator": "Exists"}],
        "affinity": {"nodeAffinity": {}},
    }
    mine = {"prometheus.io/scrape": "false", "example.org/owner": "me"}
    inject = {"sidecar.istio.io/inject": "false"}
    mission = {"enabled": True, "podAnnotations": inject}
    objects = render({"cloud": {**where, "podAnnotations": mine}, "mission": mission})
    pods = pod_specs(objects)
    assert all(where.items() <= pods[n].items() for n in ("cloud", "mission", "test", "test-link"))
    assert not where.keys() & pods["world"].keys()
    cloud = of_kind(objects, "Deployment")["cloud"]["spec"]["template"]["metadata"]["annotations"]
    assert mine.items() <= cloud.items()
    (job,) = of_kind(objects, "Job").values()
    assert job["spec"]["template"]["metadata"]["annotations"] == inject
    for pod in of_kind(objects, "Pod").values():
        assert pod["metadata"]["annotations"].items() > inject.items()


def test_every_container_takes_environment_and_mounts_of_the_user():
    objects = render(values_of(CHART / "ci" / "everything-values.yaml"))
    specs = pod_specs(objects)
    found = [containers(specs[pod]) for pod in ("world", "cloud", "mission")]
    named = {name: one for pod in found for name, one in pod.items() if name != "load"}
    ends = {"world", "cloud", "link"}
    assert named.keys() == {*ends, "teleop", "ros", "nodes", "bridge", "console", "mission"}
    for name, one in named.items():
        assert {"name": "TZ", "value": "UTC"} in one["env"], name
        assert "certificates" in {mount["name"] for mount in one["volumeMounts"]}, name
    for pod in ("world", "cloud", "mission"):
        assert "certificates" in {volume["name"] for volume in specs[pod]["volumes"]}, pod
    assert specs["world"]["priorityClassName"] == "robots"
    assert specs["world"]["runtimeClassName"] == "gvisor"
    assert "priorityClassName" not in specs["cloud"]


def test_common_labels_are_on_every_object_and_pod_and_those_of_a_pod_win():
    values = {
        "commonLabels": {"team": "robots", "site": "a"},
        "world": {"podLabels": {"site": "b"}},
        "mission": {"enabled": True, "podLabels": {"sidecar.istio.io/inject": "false"}},
        "metrics": {"podMonitor": {"enabled": True, "force": True, "labels": {"team": "ops"}}},
        "dashboards": {"enabled": True},
    }
    objects = render(values)
    for thing in objects:
        assert thing["metadata"]["labels"]["site"] == "a"
    (monitor,) = of_kind(objects, "PodMonitor").values()
    assert monitor["metadata"]["labels"]["team"] == "ops"
    deployments = of_kind(objects, "Deployment")
    labels = deployments["world"]["spec"]["template"]["metadata"]["labels"]
    assert (labels["team"], labels["site"]) == ("robots", "b")
    assert deployments["world"]["spec"]["revisionHistoryLimit"] == 10
    alone = [thing for thing in objects if thing["kind"] == "Pod"]
    alone += [thing["spec"]["template"] for thing in of_kind(objects, "Job").values()]
    assert len(alone) == 3  # the mission's, and two of helm test
    for thing in alone:
        assert thing["metadata"]["labels"]["sidecar.istio.io/inject"] == "false"


def test_every_container_takes_environment_variables_and_mounts_of_its_own():
    pods = pod_specs(render(values_of(CHART / "ci" / "everything-values.yaml")))
    parts = [(name, pod, part) for name, pod in pods.items() for part in containers(pod).values()]
    assert len(parts) == 13
    for name, pod, part in parts:
        where = name, part["name"]
        assert {"name": "TZ", "value": "UTC"} in part.get("env", []), where
        mounts = {mount["name"] for mount in part.get("volumeMounts", [])}
        assert "certificates" in mounts, where
        assert mounts <= {volume["name"] for volume in pod.get("volumes", [])}, where


def test_the_command_line_accepts_every_containers_arguments():
    load = {"backgroundLoad": {"enabled": True, "workers": 3}}
    on = {"enabled": True}
    more = {"mission": {**on, "queue": True}, "console": on, "ros": {**on, "steer": True}}
    pods = pod_specs(render({**more, "cloud": load}))
    assert list(containers(pods["cloud"])) == [
        "link",
        "cloud",
        "teleop",
        "bridge",
        "console",
        "load",
    ]
    assert "seq 3" in containers(pods["cloud"])["load"]["command"][-1]
    parts = [part for pod in pods.values() for part in containers(pod).values() if "args" in part]
    assert len(parts) == 10
    for part in parts:
        arguments = [re.sub(r"\$\((\w+)\)", r"\1", text) for text in part["args"]]
        assert callable(build_parser([arguments[0]]).parse_args(arguments).execute)


def test_each_pod_has_one_image():
    """A node pulls one image per pod, because the link uses the same image."""

    def images(values):
        found = {}
        for name, pod in pod_specs(render({"image": values})).items():
            (found[name],) = {container["image"] for container in containers(pod).values()}
        return found

    cloud, world = (f"cloudrc/{role}:{cloudrc.__version__}" for role in ("cloud", "world"))
    assert images({}) == {"world": world, "cloud": cloud, "test": cloud, "test-link": cloud}
    digest = "sha256:" + "0" * 64
    cloud_pod = pod_specs(render({"console": {"enabled": True}}))["cloud"]
    drawn = containers(cloud_pod)["console"]["image"]
    assert drawn == world, "the cloud image has no physics"
    found = images({"registry": "ghcr.io/me", "tag": "9.9.9", "world": {"digest": digest}})
    assert found["world"] == f"ghcr.io/me/cloudrc/world@{digest}"
    assert found["cloud"] == "ghcr.io/me/cloudrc/cloud:9.9.9"


def test_the_notes_are_three_commands_for_this_release():
    text = notes(release="flight", namespace="lab-7")
    wait, fly, logs = (shlex.split(line) for line in text.splitlines() if line.startswith("  "))
    for words in (wait, fly, logs):
        assert words[words.index("--namespace") + 1] == "lab-7"
    assert wait[wait.index("--selector") + 1] == "app.kubernetes.io/instance=flight"
    options = build_parser([fly[1]]).parse_args(fly[1:])
    assert (fly[0], options.namespace, options.release) == ("cloudrc", "lab-7", "flight")
    name = next(w.partition("/")[2] for w in logs if w.startswith("deployment/"))
    assert name in of_kind(render(release="flight"), "Deployment")
    assert logs[logs.index("--container") + 1] == "link"


def test_the_notes_of_an_upgrade_give_the_same_commands_and_say_what_restarts():
    def commands(text):
        return [line for line in text.splitlines() if line.startswith("  ")]

    assert commands(notes(upgrade=True)) == commands(notes())
    assert "restarts its pod" in notes(upgrade=True)
    assert "restarts" not in notes()


SLOW = "experiment.guard.command_age_max_ms=800"
CLOSED = "No Prometheus may scrape"
TOPICS = "topics of ROS 2, which know no token"


@pytest.mark.parametrize(
    ("values", "words", "warns"),
    [
        ({}, SLOW, False),
        ({"link": {"profile": "satellite"}}, SLOW, True),
        ({"experiment": {"link": {"profile": "satellite"}}}, SLOW, False),
        ({}, CLOSED, True),
        ({"metrics": {"allowFrom": [{"ipBlock": {"cidr": "10.0.0.0/8"}}]}}, CLOSED, False),
        ({"networkPolicy": {"enabled": False}}, TOPICS, False),
        ({"networkPolicy": {"enabled": False}, "ros": {"enabled": True}}, TOPICS, True),
    ],
)
def test_the_notes_warn_of_what_will_not_work(values, words, warns):
    """The guard's limit is in the experiment, because a change of the link restarts nothing."""
    assert (words in notes(values)) is warns


def test_helm_keeps_the_journal_only_if_asked_to_and_the_notes_say_so():
    for keep in (False, True):
        values = {"teleop": {"journal": {"keep": keep}}}
        (claim,) = of_kind(render(values), "PersistentVolumeClaim").values()
        annotations = claim["metadata"].get("annotations", {})
        assert (annotations.get("helm.sh/resource-policy") == "keep") is keep
        assert ("teleop.journal.keep=true" in notes(values)) is not keep
