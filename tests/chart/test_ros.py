"""ROS 2 in the cloud pod: which controller flies, and what is refused."""

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
