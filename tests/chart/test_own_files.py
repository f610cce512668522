"""The user's robot and scene are ConfigMaps that each container with the experiment mounts."""

import pytest
import yaml

from tests.chart.conftest import a_namespace, containers, notes, of_kind, pod_specs, render

OWN = {"robot": {"configMap": "mine"}, "scene": {"configMap": "lab"}}
FOLDERS = {"robot": "/etc/cloudrc-robot/mine", "scene": "/etc/cloudrc-scene/lab"}


def files(name, *keys):
    data = dict.fromkeys(keys, "text")
    return {"kind": "ConfigMap", "metadata": {"name": name}, "data": data}


PRESENT = [files("mine", "robot.yaml", "robot.xml"), files("lab", "scene.xml")]


def test_the_users_robot_and_scene_replace_those_of_the_experiment():
    given = {"seed": 4, "world": {"robot": "rover", "odometry_rate_hz": 50}}
    data = of_kind(render({**OWN, "experiment": given}), "ConfigMap")["experiment"]["data"]
    experiment = yaml.safe_load(data["experiment.yaml"])
    world = {"robot": FOLDERS["robot"], "scene": f"{FOLDERS['scene']}/scene.xml"}
    assert experiment == {"seed": 4, "world": {**world, "odometry_rate_hz": 50}}


def test_every_container_that_reads_the_experiment_reads_robot_and_scene():
    pods = pod_specs(render({**OWN, "console": {"enabled": True}, "ros": {"enabled": True}}))
    seen = set()
    for end in ("world", "cloud"):
        volumes = {each["name"]: each for each in pods[end]["volumes"]}
        for name, container in containers(pods[end]).items():
            mounts = {m["mountPath"]: m["name"] for m in container.get("volumeMounts") or ()}
            if "/etc/cloudrc" not in mounts:
                continue
            seen.add(name)
            for kind, folder in FOLDERS.items():
                source = volumes[mounts[folder]]["configMap"]["name"]
                assert source == OWN[kind]["configMap"]
    assert seen == {"world", "link", "cloud", "teleop", "bridge", "console"}


@pytest.mark.parametrize(
    ("objects", "said"),
    [
        ([], "robot.configMap: no ConfigMap 'mine' in namespace 'lab'.*--from-file=FOLDER"),
        ([files("mine", "robot.xml")], "ConfigMap 'mine' has no robot.yaml; make it: kubectl"),
        (PRESENT[:1], "scene.configMap: no ConfigMap 'lab'.*--from-file=scene.xml=FILE"),
    ],
)
def test_a_configmap_that_the_pods_could_not_use_is_refused(objects, said):
    with pytest.raises(Exception, match=said):
        render(OWN, lookup=a_namespace(objects=objects))
    render(OWN)  # helm template cannot ask


def test_changed_files_restart_the_pods():
    def annotations(*objects):
        made = render(OWN, lookup=a_namespace(objects=objects))
        pods = of_kind(made, "Deployment")
        return [pods[end]["spec"]["template"]["metadata"]["annotations"] for end in pods]

    before = annotations(*PRESENT)
    assert annotations(*PRESENT) == before
    for one, other in zip(
        before, annotations(files("mine", "robot.yaml"), PRESENT[1]), strict=True
    ):
        assert {key for key in one if one[key] != other[key]} == {"checksum/experiment"}


def test_helm_test_and_notes_fly_the_mission_of_the_experiment():
    def flown(mission):
        made = render({"experiment": {"mission": mission} if mission else {}})
        return yaml.safe_load(of_kind(made, "ConfigMap")["test"]["data"]["mission.yaml"])

    assert len(flown("pillars")["waypoints"][0]["position_m"]) == 2, "a robot on the ground"
    assert flown("carrot")["carrot"]
    short = flown(None)
    assert len(short["waypoints"]) == 1
    assert flown("steps") == short, "the API flies no steps"
    rover = {"world": {"robot": "rover", "scene": "pillars"}, "mission": "pillars"}
    text = notes({"experiment": rover})
    assert "cloudrc mission run pillars" in text
    assert "Robot: rover, in the scene pillars" in text
    assert "Robot: mine, in the scene lab" in notes(OWN)
