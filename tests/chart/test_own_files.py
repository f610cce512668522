# SPDX-License-Identifier: Apache-2.0

"""The user's robot and scene are ConfigMaps that each container with the experiment mounts."""

import pytest
import yaml

from tests.chart.conftest import a_namespace, notes, of_kind, render

OWN = "{robot: {configMap: mine}, scene: {configMap: lab}}"


def files(name, *keys):
    return {"kind": "ConfigMap", "metadata": {"name": name}, "data": dict.fromkeys(keys, "text")}


PRESENT = [files("mine", "robot.yaml", "robot.xml"), files("lab", "scene.xml")]


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


def test_helm_test_and_notes_fly_the_mission_of_the_experiment():
    def flown(mission):
        values = {"experiment": {"mission": mission} if mission else {}}
        made = render(values, only="templates/tests/")
        return yaml.safe_load(of_kind(made, "ConfigMap")["test"]["data"]["mission.yaml"])

    assert len(flown("pillars")["waypoints"][0]["position_m"]) == 2, "a robot on the ground"
    assert flown("carrot")["carrot"]
    short = flown(None)
    assert len(short["waypoints"]) == 1
    assert flown("steps") == short, "the API flies no steps"
    text = notes("experiment: {world: {robot: rover, scene: pillars}, mission: pillars}")
    assert "cloudrc mission run pillars" in text
    assert "Robot: rover, in the scene pillars" in text
    assert "Robot: mine, in the scene lab" in notes(OWN)
