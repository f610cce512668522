# SPDX-License-Identifier: Apache-2.0

"""`cloudrc link relay ros` puts a link between two topics: `make ros2-test` runs these tests."""

import json
import subprocess
import sys
import time
from contextlib import closing, contextmanager
from importlib.util import find_spec

import pytest

import cloudrc.link
from tests.doors.bridges.conftest import needs_ros

pytestmark = needs_ros
if find_spec("rclpy"):
    from geometry_msgs.msg import Point
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.qos import QoSProfile, ReliabilityPolicy

    from cloudrc.doors.bridges.ros2.own_node import OwnNode

    LOSSY = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
    SAFE = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
WORDS = ["link", "relay", "ros", "--from", "/odom", "--to", "/remote/odom"]
PROFILE = {"uplink": {"delay_ms": 70, "jitter_ms": 40, "loss": 0.05, "duplicate": 0.05}}
PERIOD = 0.005  # between two messages [s]


class Robot:
    """A node that publishes numbered points on /odom, and hears them on /remote/odom."""

    def __init__(self, heard):
        own = OwnNode("robot")
        self.node, self.close = own.node, own.close
        self._publisher = self.node.create_publisher(Point, "/odom", SAFE)
        self.node.create_subscription(Point, "/remote/odom", self._hear, heard)
        self._executor = SingleThreadedExecutor(context=own.context)
        self._executor.add_node(self.node)
        self.sent, self.ages = {}, {}  # number -> time of sending, ages of the copies [s]

    def _hear(self, point):
        self.ages.setdefault(point.x, []).append(time.monotonic() - self.sent[point.x])

    def spin(self, seconds):
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=left)

    def meet(self):
        """Wait for the relay; its subscription and its publisher may not come at once."""
        end = time.monotonic() + 30
        while time.monotonic() < end and not (
            self._publisher.get_subscription_count() and self.node.count_publishers("/remote/odom")
        ):
            self.spin(0.1)
        self.spin(0.5)

    def publish(self, count):
        for _ in range(count):
            number = float(len(self.sent))
            self.sent[number] = time.monotonic()
            self._publisher.publish(Point(x=number, y=0.1, z=-1e300))
            self.spin(PERIOD - (time.monotonic() - self.sent[number]))
        self.spin(0.5)


@contextmanager
def relay(*words):
    """Run the command in a process of its own; yield how to end it, with its report and words."""
    command = [sys.executable, "-m", "cloudrc", *WORDS, "-o", "json", *words]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)

    def end():
        process.terminate()
        report, words = process.communicate(timeout=60)
        assert process.returncode == 0, words
        return json.loads(report), words.decode()

    try:
        yield end
    finally:
        process.kill()


@pytest.mark.smoke
def test_messages_cross_as_the_profile_and_the_seed_say(tmp_path):
    profile = tmp_path / "profile.yaml"
    profile.write_text(json.dumps(PROFILE))
    words = ["--link", str(profile), "--seed", "5", "--stream", "b", "--out", str(tmp_path / "run")]
    with closing(Robot(LOSSY)) as one, relay(*words) as end:
        one.meet()
        one.publish(400)
        report, _ = end()
    up, _ = cloudrc.link.open(PROFILE, 5, stream="b")
    packets = [up.send(1, number, 24, 0) for number in range(400)]
    assert {n: len(ages) for n, ages in one.ages.items()} == {
        float(n): len(arrivals) for n, arrivals in enumerate(packets) if arrivals
    }
    assert (report["verdict"], report["type"]) == ("believed", "geometry_msgs/msg/Point")
    assert report["counts"]["received"] == 400
    rows = (tmp_path / "run" / "uplink.csv").read_text().splitlines()
    assert len(rows) == 401
    assert json.loads((tmp_path / "run" / "link.json").read_text()) == report


@pytest.mark.parametrize("flags", [[], ["--reliable"]])
def test_a_subscription_that_wants_reliable_needs_a_flag_and_is_told_so(flags):
    with closing(Robot(SAFE)) as one, relay(*flags) as end:
        one.meet()
        one.publish(500)
        _, words = end()
    assert len(one.ages) == (500 if flags else 0)
    assert ("see --reliable" in words) is not bool(flags)
