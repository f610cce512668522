"""ROS 2 in the cloud pod: cloudrc's node, the nodes of the user, and the bridge of the flight."""

import pytest
import yaml

import cloudrc
from cloudrc.cli.main import build_parser
from tests.chart.conftest import containers, of_kind, pod_specs, render

ON = {"ros": {"enabled": True}}
SHOWN = {"ros": {"enabled": True}, "cloud": ON}
STEERED = {**SHOWN, "ros": {"enabled": True, "steer": True, "namespace": "drone1"}}
NAMED = {"controller": {"name": "ros2", "namespace": "drone1"}}


def cloud_of(values):
    return containers(pod_specs(render(values))["cloud"])


def controller_of(values):
    text = of_kind(render(values), "ConfigMap")["experiment"]["data"]["experiment.yaml"]
    return yaml.safe_load(text)["cloud"]["controller"]


def mounts_of(part):
    return {mount["mountPath"]: mount["name"] for mount in part["volumeMounts"]}


def test_without_ros_the_pod_has_neither_its_containers_nor_its_image():
    parts = cloud_of({})
    assert not {"ros", "nodes", "bridge"} & parts.keys()
    assert "--records" not in str(parts["cloud"]["args"])
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
    parts = cloud_of(SHOWN)
    for name in ("ros", "nodes", "bridge"):
        env = {each["name"]: each["value"] for each in parts[name]["env"]}
        assert env["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "LOCALHOST"
        assert mounts_of(parts[name])["/dev/shm"] == "shm", "Fast DDS takes messages through it"
        assert "ports" not in parts[name]
    assert mounts_of(parts["nodes"]).keys() == {"/tmp", "/dev/shm"}
    policies = [of_kind(render(each), "NetworkPolicy") for each in ({}, STEERED)]
    assert policies[0] == policies[1]


def test_containers_share_no_home_from_which_python_would_run_files():
    parts = cloud_of(SHOWN)
    assert len({mounts_of(parts[name])["/tmp"] for name in ("ros", "nodes", "bridge")}) == 3


def bridge_of(values):
    """Return the container `bridge` and its arguments, as the command line reads them."""
    part = cloud_of(values)["bridge"]
    return part, build_parser(["ros"]).parse_args(part["args"])


def test_a_bridge_reads_the_records_of_cloud_and_nothing_by_which_it_could_steer():
    part, options = bridge_of(SHOWN)
    cloud = cloud_of(SHOWN)["cloud"]
    folder = str(options.records)
    assert f"--records={folder}" in cloud["args"]
    assert mounts_of(cloud)[folder] == mounts_of(part)[folder] == "records"
    assert mounts_of(part).keys() == {"/etc/cloudrc", folder, "/tmp", "/dev/shm"}
    assert options.token_file is None


def test_a_bridge_steers_with_the_token_of_the_api():
    part, options = bridge_of(STEERED)
    assert mounts_of(part)[str(options.token_file.parent)] == "tokens"
    assert (options.token_file.name, options.namespace) == ("operator", "drone1")


def test_only_the_bridge_needs_the_image_with_ros():
    parts = cloud_of({"ros": {"enabled": True}})
    assert {name for name, part in parts.items() if "ros" in part["image"]} == {"bridge"}


def test_a_namespace_that_ros_refuses_is_refused_at_the_install():
    with pytest.raises(Exception, match="drone-1"):
        render({"ros": {"enabled": True, "namespace": "drone-1"}})


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
