"""A plain node of ROS 2 sees a flight and steers it: `make ros2-test` runs this in a real ROS 2."""

import os
import threading
import time
from contextlib import contextmanager
from importlib.util import find_spec

import pytest

from cloudrc.bridges.ros2.requests import RosRequests
from cloudrc.console.steering import Steering
from cloudrc.drivers.readers import RecordReader, RecordSender
from cloudrc.geometry.shapes import Shapes
from cloudrc.messages import UPRIGHT, ZERO, GuardState, Odometry, Telemetry
from cloudrc.records import Lateness
from cloudrc.report.markers import encode_markers, scene_shapes
from tests.console.conftest import FakeApi, control, start

pytestmark = [
    pytest.mark.ros2,
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),  # of ROS's own packages
    pytest.mark.skipif(find_spec("rclpy") is None, reason="needs a sourced ROS 2: make ros2-test"),
]
PERIOD = 0.01
"""Time between two telemetries of the tests' cloud [s]."""


@pytest.fixture(autouse=True)
def own_domain(monkeypatch):
    """Keep the tests apart from other nodes of this machine."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(101 + os.getpid() % 100))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")


class Watcher:
    """A plain node: topic -> the messages that it has got."""

    def __init__(self, **topics):
        import rclpy
        from rclpy.executors import SingleThreadedExecutor

        self._context = rclpy.Context()
        rclpy.init(args=[], context=self._context)
        self.node = rclpy.create_node("watcher", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self.got = {name: [] for name in topics}
        for name, (topic, kind) in topics.items():
            self.node.create_subscription(kind, topic, self.got[name].append, 10)

    def wait(self, found, limit=10.0):
        end = time.monotonic() + limit
        while not found() and time.monotonic() < end:
            self._executor.spin_once(timeout_sec=0.02)
        assert found()

    def call(self, service):
        from std_srvs.srv import Trigger

        client = self.node.create_client(Trigger, service)
        self.wait(client.service_is_ready)
        answer = client.call_async(Trigger.Request())
        self.wait(answer.done)
        return answer.result()

    def close(self):
        self.node.destroy_node()
        self._context.shutdown()


@pytest.fixture
def watcher():
    from diagnostic_msgs.msg import DiagnosticArray
    from nav_msgs.msg import Odometry as RosOdometry
    from std_msgs.msg import String
    from visualization_msgs.msg import MarkerArray

    watcher = Watcher(
        odom=("/drone1/odom", RosOdometry),
        guard=("/drone1/cloudrc/guard", String),
        scene=("/drone1/cloudrc/scene", MarkerArray),
        diagnostics=("/diagnostics", DiagnosticArray),
    )
    yield watcher
    watcher.close()


def fly(sender, ended):
    """Send telemetry as cloud does, until the event `ended`."""
    number = 0
    while not ended.wait(PERIOD):
        number += 1
        stamp_ns = time.monotonic_ns()
        odometry = Odometry(stamp_ns, (1.0, 2.0, 3.0), UPRIGHT, ZERO, ZERO)
        sender.see(1, number, Telemetry(stamp_ns, odometry, (), -1, 0, 0, 0, GuardState.TRACK))
        sender.put([control(stamp_ns * 1e-9), Lateness(stamp_ns, "cloud", 0.001, 0.0, 0)])


@contextmanager
def bridge(folder, said):
    """Run a bridge beside a cloud that flies; yield the API that it calls."""
    from cloudrc.bridges.ros2.bridge import RosBridge

    api, ended = FakeApi(), threading.Event()
    api.answers["/v1/state"] = {"mission": None}
    steering, sender = Steering(api), RecordSender(folder)
    robot = {"planar": False, "heading": "free", "prefix": "drone1/"}
    requests = RosRequests(steering, said.append, **robot)
    scene = encode_markers(0, scene_shapes(Shapes(), (), "drone1/"))
    node = RosBridge("drone1", "drone1/", scene, steering, requests, said.append)
    reader = RecordReader(folder)
    steering.start()
    threads = [
        threading.Thread(target=fly, args=(sender, ended)),
        threading.Thread(target=node.run, args=(reader, ended.is_set)),
    ]
    for thread in threads:
        thread.start()
    try:
        yield api
    finally:
        ended.set()
        for thread in threads:
            thread.join()
        node.close()
        reader.close()
        sender.close()
        steering.end_drive()


@pytest.mark.smoke
def test_a_plain_node_sees_the_robot_and_steers_it(tmp_path, watcher):
    from geometry_msgs.msg import PoseStamped, TwistStamped

    said, got = [], watcher.got
    goals = watcher.node.create_publisher(PoseStamped, "/drone1/goal_pose", 1)
    velocities = watcher.node.create_publisher(TwistStamped, "/drone1/cmd_vel", 1)
    with bridge(tmp_path, said) as api:
        watcher.wait(lambda: len(got["odom"]) > 100 and all(got.values()))
        stamps = [each.header.stamp.sec + each.header.stamp.nanosec * 1e-9 for each in got["odom"]]
        assert time.time() - 5.0 < stamps[-1] <= time.time()
        assert got["odom"][-1].child_frame_id == "drone1/base_link"
        assert got["odom"][-1].pose.pose.position.z == 3.0
        assert {each.data for each in got["guard"]} == {"TRACK"}
        assert [each.name for each in got["diagnostics"][-1].status] == ["robot", "link", "cloud"]

        watcher.wait(lambda: goals.get_subscription_count())
        goal = PoseStamped()
        goal.pose.position.x = 1.5
        goals.publish(goal)
        order = ("/v1/goto", {"position_m": [1.5, 0.0, 3.0], "yaw_deg": 0.0})
        watcher.wait(lambda: order in api.posted)

        watcher.wait(lambda: velocities.get_subscription_count())  # of the type with a stamp
        velocity = TwistStamped()
        velocity.twist.linear.x = 0.5
        velocities.publish(velocity)
        watcher.wait(lambda: ("/v1/drive", {"velocity_mps": (0.5, 0.0, 0.0)}) in api.posted)
        watcher.wait(lambda: api.posted[-1] == ("/v1/drive", {"velocity_mps": ZERO}))

        answer = watcher.call("/drone1/cloudrc/estop")
        assert answer.success, answer.message
        assert api.posted[-1] == ("/v1/estop", None)
    assert "/drone1/odom" in " ".join(said)


def test_the_bridge_of_a_session_ends_with_it(tmp_path, monkeypatch):
    from nav_msgs.msg import Odometry as RosOdometry

    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    watcher = Watcher(odom=("/odom", RosOdometry))
    session = start(tmp_path, "up", "hover")
    said = session.stdout.readline()
    while "to end" not in said:
        said = session.stdout.readline()
    command = start(tmp_path, "ros", "bridge")
    watcher.wait(lambda: len(watcher.got["odom"]) > 100, 30.0)
    assert watcher.call("/cloudrc/acknowledge").message
    session.terminate()
    output, _ = command.communicate(timeout=30)
    assert command.returncode == 0, output
    assert "the flight has ended" in output
    session.communicate(timeout=30)
    watcher.close()
