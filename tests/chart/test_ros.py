"""ROS 2 in the cloud pod: cloudrc's node, and the nodes of the user."""

import pytest
import yaml

import cloudrc
from cloudrc.cli.main import build_parser
from tests.chart.conftest import containers, of_kind, pod_specs, render

ON = {"ros": {"enabled": True}}
NAMED = {"controller": {"name": "ros2", "namespace": "drone1"}}


def cloud_of(values):
    return containers(pod_specs(render(values))["cloud"])


def controller_of(values):
    text = of_kind(render(values), "ConfigMap")["experiment"]["data"]["experiment.yaml"]
    return yaml.safe_load(text)["cloud"]["controller"]


def test_without_ros_the_pod_has_neither_its_containers_nor_its_image():
    parts = cloud_of({})
    assert not {"ros", "nodes"} & parts.keys()
    assert "ros" not in str({part["image"] for part in parts.values()})


def test_the_launch_command_runs_in_ros_word_by_word():
    launch = ["ros2", "launch", "lab", "all.launch.py", "gain:=0.5 # not YAML", "true"]
    nodes = cloud_of({"cloud": {"ros": {"enabled": True, "launch": launch}}})["nodes"]
    assert (nodes["command"], nodes["args"]) == (["with-ros"], launch)


def test_cloudrcs_node_is_a_process_beside_cloud():
    parts = cloud_of({"cloud": ON})
    arguments = parts["ros"]["args"]
    options = build_parser([arguments[0]]).parse_args(arguments)
    assert str(options.config) == "/etc/cloudrc/experiment.yaml"
    assert f"--teleop={options.socket}" in parts["cloud"]["args"]
    assert not options.feed


def test_one_image_with_ros_serves_the_whole_pod_and_the_missions():
    image = {"repository": "lab/nodes", "digest": ""}
    values = {"cloud": {"ros": {"enabled": True, "image": image}}, "mission": {"enabled": True}}
    pods = pod_specs(render({**values, "image": {"registry": "ghcr.io/me"}}))
    found = {pod: {one["image"] for one in containers(spec).values()} for pod, spec in pods.items()}
    of = {
        name: {f"ghcr.io/me/{name}:{cloudrc.__version__}"}
        for name in ("cloudrc/world", "lab/nodes")
    }
    assert found.pop("world") == of["cloudrc/world"]
    assert {frozenset(each) for each in found.values()} == {frozenset(of["lab/nodes"])}


def test_dds_stays_in_the_pod_and_the_nodes_reach_no_socket_token_or_key():
    parts = cloud_of({"cloud": ON})
    for name in ("ros", "nodes"):
        env = {each["name"]: each["value"] for each in parts[name]["env"]}
        assert env["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "LOCALHOST"
        assert env["FASTDDS_BUILTIN_TRANSPORTS"] == "UDPv4", "containers need not share memory"
        assert "ports" not in parts[name]
    assert [mount["mountPath"] for mount in parts["nodes"]["volumeMounts"]] == ["/tmp"]
    policies = [of_kind(render({"cloud": each}), "NetworkPolicy") for each in ({}, ON)]
    assert policies[0] == policies[1]


def test_the_controller_is_ros2_also_with_a_namespace():
    assert controller_of({"cloud": ON}) == "ros2"
    experiment = {"cloud": {"predictor": "last_sample"}}
    assert controller_of({"cloud": ON, "experiment": experiment}) == "ros2"
    assert controller_of({"cloud": ON, "experiment": {"cloud": NAMED}}) == NAMED["controller"]


@pytest.mark.parametrize(
    ("ros", "controller", "said"),
    [
        ({"enabled": True}, "p", "experiment.cloud.controller is 'p'; leave it out"),
        ({"enabled": True}, {"name": "p"}, "experiment.cloud.controller is 'p'; leave it out"),
        ({}, "ros2", "set cloud.ros.enabled=true"),
        ({}, NAMED["controller"], "set cloud.ros.enabled=true"),
        ({"enabled": True, "launch": []}, "ros2", "cloud.ros.launch: is empty"),
    ],
)
def test_what_could_not_fly_is_refused_at_the_install(ros, controller, said):
    values = {"cloud": {"ros": ros}, "experiment": {"cloud": {"controller": controller}}}
    with pytest.raises(Exception, match=said):
        render(values)
