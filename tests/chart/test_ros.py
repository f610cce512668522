"""ROS 2 in the cloud pod: which controller flies, and what is refused."""

import pytest
import yaml

from tests.chart.conftest import of_kind, render

NAMED = {"controller": {"name": "ros2", "namespace": "drone1"}}


ON = {"ros": {"enabled": True}}


def controller_of(values):
    text = of_kind(render(values), "ConfigMap")["experiment"]["data"]["experiment.yaml"]
    return yaml.safe_load(text)["cloud"]["controller"]


def test_the_controller_is_ros2_also_with_a_namespace():
    assert controller_of({"cloud": ON}) == "ros2"
    experiment = {"cloud": {"predictor": "last_sample"}}
    assert controller_of({"cloud": ON, "experiment": experiment}) == "ros2"
    assert controller_of({"cloud": ON, "experiment": {"cloud": NAMED}}) == NAMED["controller"]


@pytest.mark.parametrize(
    ("ros", "controller", "said"),
    [
        ({"enabled": True}, {"name": "p"}, "experiment.cloud.controller is 'p'; leave it out"),
        ({}, NAMED["controller"], "set cloud.ros.enabled=true"),
        ({"enabled": True, "launch": []}, "ros2", "cloud.ros.launch: is empty"),
    ],
)
def test_what_could_not_fly_is_refused_at_the_install(ros, controller, said):
    values = {"cloud": {"ros": ros}, "experiment": {"cloud": {"controller": controller}}}
    with pytest.raises(Exception, match=said):
        render(values)
