# SPDX-License-Identifier: Apache-2.0

"""A plain node of ROS 2 sees a flight and steers it: `make ros2-test` runs this in a real ROS 2."""

import subprocess
import sys
import threading
import time
from contextlib import closing, contextmanager
from importlib.util import find_spec
from math import atan2, degrees
from pathlib import Path
from shutil import which

import pytest

from cloudrc.doors.bridges.ros2.description import RobotFrames, urdf
from cloudrc.doors.bridges.ros2.requests import RosRequests
from cloudrc.doors.console.steering import Steering
from cloudrc.flight.pod.readers import RecordReader, RecordSender
from cloudrc.physics.geometry.scene import Scene
from cloudrc.physics.geometry.shapes import Shapes
from cloudrc.results.report.markers import encode_markers, scene_shapes
from cloudrc.wire.messages import ZERO
from cloudrc.wire.pictures import Jpeg
from cloudrc.wire.records import Lateness
from tests.doors.bridges.conftest import needs_ros
from tests.doors.console.conftest import FakeApi, control, start
from tests.support.camera import needs_renderer
from tests.support.told import told

pytestmark = needs_ros
SUCCEEDED, ABORTED = 4, 6
"""Status of an action that has ended, as in action_msgs/GoalStatus."""
PERIOD = 0.01
"""Time between two telemetries of the tests' cloud [s]."""


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
        sender.see(1, number, told(stamp_ns).telemetry)
        sender.put([control(stamp_ns * 1e-9), Lateness(stamp_ns, "cloud", 0.001, 0.0, 0)])


@contextmanager
def bridge(folder, said):
    """Run a bridge beside a cloud that flies; yield the API that it calls."""
    from cloudrc.doors.bridges.ros2.bridge import RosBridge, Shown

    api, ended = FakeApi(), threading.Event()
    api.answers["/v1/state"] = {"mission": None}
    steering, sender = Steering(api), RecordSender(folder)
    frames = RobotFrames("drone1/", rep_105=True)
    robot = {"planar": False, "heading": "free", "frames": frames}
    requests = RosRequests(steering, said.append, **robot)
    scene = encode_markers(0, scene_shapes(Shapes(), Scene("empty"), "drone1/"))
    shown = Shown(frames, scene, urdf("x2", frames, ()))
    node = RosBridge("drone1", shown, steering, requests, said.append)
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
        assert got["odom"][-1].header.frame_id == "drone1/odom"
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


@pytest.fixture
def nav2(tmp_path, monkeypatch):
    """A nav2_msgs with the action, of which there is no wheel."""
    if find_spec("nav2_msgs") is None:
        make = [sys.executable, "-m", "tests.doors.bridges.make_nav2", tmp_path / "nav2"]
        subprocess.run(make, check=True)
        monkeypatch.syspath_prepend(tmp_path / "nav2")


@pytest.mark.skipif(not which("g++"), reason="needs g++")
@pytest.mark.usefixtures("nav2")
def test_a_goal_of_nav2_is_flown_and_a_refused_one_says_why(tmp_path):
    from nav2_msgs.action import NavigateToPose
    from rclpy.action import ActionClient

    watcher, fed = Watcher(), []
    client = ActionClient(watcher.node, NavigateToPose, "/drone1/navigate_to_pose")

    def navigate():
        goal = NavigateToPose.Goal()
        goal.pose.pose.position.x, goal.pose.pose.position.z = 1.5, 1.0
        sent = client.send_goal_async(goal, feedback_callback=fed.append)
        watcher.wait(sent.done)
        ended = sent.result().get_result_async()
        watcher.wait(ended.done)
        return ended.result()

    with bridge(tmp_path, []) as api:
        watcher.wait(client.server_is_ready)
        api.refused["/v1/goto"] = "outside the fence"
        answer = navigate()
        assert (answer.status, answer.result.error_msg) == (ABORTED, "outside the fence")
        api.refused.clear()
        api.answers["/v1/missions"] = {"missions": [{"id": "m1", "state": "flying"}]}
        api.answers["/v1/missions/m1"] = {"state": "done"}
        assert navigate().status == SUCCEEDED
    assert fed, "no feedback"
    client.destroy()
    watcher.close()


def teleop_keyboard(twist):
    """Fill what teleop_twist_keyboard sends for its key `u`: ahead and to the left."""
    twist.linear.x, twist.angular.z = 0.5, 1.0


def nav2_controller(command):
    """Fill what Nav2's controller server sends: stamped, in the frame of the base."""
    command.header.frame_id = "base_link"
    command.twist.linear.x, command.twist.angular.z = 0.3, -0.4


def state_of(mission):
    """Return the state of a mission, as the topic tells it."""
    return {each.key: each.value for each in mission.values}.get("state", "")


@contextmanager
def session(folder, monkeypatch, *words, flags=()):
    """Begin a session and its bridge, which has to end with it."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(folder))
    flown = start(folder, "up", "--report", "none", *words)
    assert any("to end" in said for said in flown.stdout), "the session has not begun"
    command = start(folder, "ros", "bridge", *flags)
    try:
        yield
    finally:
        flown.terminate()
        output, _ = command.communicate(timeout=30)
        flown.communicate(timeout=30)
    assert command.returncode == 0, output
    assert "the flight has ended" in output


def test_the_messages_of_teleop_keyboard_and_of_nav2_turn_a_rover(tmp_path, monkeypatch):
    from diagnostic_msgs.msg import DiagnosticStatus
    from geometry_msgs.msg import Twist, TwistStamped
    from nav_msgs.msg import Odometry as RosOdometry

    watcher = Watcher(odom=("/odom", RosOdometry), mission=("/cloudrc/mission", DiagnosticStatus))
    got, ground = watcher.got, ("pillars", "--set", "world.scene=empty")
    with closing(watcher), session(tmp_path, monkeypatch, *ground, flags=["--rep-105"]):
        watcher.wait(lambda: len(got["odom"]) > 10, 60.0)
        assert got["odom"][-1].header.frame_id == "odom"
        for kind, fill in ((Twist, teleop_keyboard), (TwistStamped, nav2_controller)):
            commands = watcher.node.create_publisher(kind, "/cmd_vel", 1)
            watcher.wait(lambda commands=commands: commands.get_subscription_count(), 20.0)
            command = kind()
            fill(command)
            wanted = getattr(command, "twist", command).angular.z
            rates = []
            for _ in range(30):
                commands.publish(command)
                end = time.monotonic() + 0.1
                watcher.wait(lambda end=end: time.monotonic() > end)
                rates.append(got["odom"][-1].twist.twist.angular.z)
            assert sum(rates[10:]) / 20 == pytest.approx(wanted, rel=0.25)
            commands.publish(kind())
            watcher.node.destroy_publisher(commands)
        assert "held" in state_of(got["mission"][-1])


def test_scans_reach_a_node_in_the_frame_of_the_scanner(tmp_path, monkeypatch):
    from sensor_msgs.msg import LaserScan

    watcher = Watcher(scan=("/scan", LaserScan))
    with closing(watcher), session(tmp_path, monkeypatch, "gap"):
        watcher.wait(lambda: len(watcher.got["scan"]) > 10, 60.0)
        scan = watcher.got["scan"][-1]
        assert (scan.header.frame_id, len(scan.ranges)) == ("lidar", 181)
        assert scan.angle_max == pytest.approx(-scan.angle_min)
        assert abs(time.time() - scan.header.stamp.sec) < 5.0
        first, second = watcher.got["scan"][-2:]
        period = second.header.stamp.nanosec - first.header.stamp.nanosec
        assert period * 1e-9 % 1.0 == pytest.approx(0.1, abs=0.03)


@needs_renderer
def test_pictures_reach_a_node_in_the_frame_of_the_camera(tmp_path, monkeypatch):
    from sensor_msgs.msg import CompressedImage

    watcher = Watcher(camera=("/camera/compressed", CompressedImage))
    with closing(watcher), session(tmp_path, monkeypatch, "follow"):
        watcher.wait(lambda: len(watcher.got["camera"]) > 10, 60.0)
        first, second = watcher.got["camera"][-2:]
        assert (second.header.frame_id, second.format) == ("camera", "jpeg")
        assert abs(time.time() - second.header.stamp.sec) < 5.0
        assert Jpeg().decode(bytes(second.data)).shape == (240, 320, 3)
        period = (second.header.stamp.nanosec - first.header.stamp.nanosec) * 1e-9 % 1.0
        assert 0.06 < period < 0.5, "some may be late"


@pytest.mark.skipif(not which("g++"), reason="needs g++")
@pytest.mark.usefixtures("nav2")
@pytest.mark.parametrize("asked", ["topic", "action"])
def test_a_goal_with_a_yaw_turns_a_rover(tmp_path, monkeypatch, asked):
    """It arrives, and turns on the spot."""
    from diagnostic_msgs.msg import DiagnosticStatus
    from geometry_msgs.msg import PoseStamped
    from nav2_msgs.action import NavigateToPose
    from nav_msgs.msg import Odometry as RosOdometry
    from rclpy.action import ActionClient

    package = Path(find_spec("nav2_msgs").submodule_search_locations[0])
    monkeypatch.setenv("PYTHONPATH", str(package.parent))  # for the bridge, too
    watcher = Watcher(odom=("/odom", RosOdometry), mission=("/cloudrc/mission", DiagnosticStatus))
    client = ActionClient(watcher.node, NavigateToPose, "/navigate_to_pose")
    goals, got = watcher.node.create_publisher(PoseStamped, "/goal_pose", 1), watcher.got
    goal = PoseStamped()
    goal.pose.position.x, turn = 1.0, goal.pose.orientation
    turn.z = turn.w = 0.5**0.5  # 90 degrees
    ground = "pillars", "--set", "world.scene=empty"
    with closing(watcher), session(tmp_path, monkeypatch, *ground):
        watcher.wait(lambda: len(got["odom"]) > 10 and goals.get_subscription_count(), 60.0)
        if asked == "topic":
            goals.publish(goal)
            watcher.wait(lambda: got["mission"] and "done" in state_of(got["mission"][-1]), 60.0)
        else:
            watcher.wait(client.server_is_ready, 20.0)
            sent = client.send_goal_async(NavigateToPose.Goal(pose=goal))
            watcher.wait(sent.done)
            ended = sent.result().get_result_async()
            watcher.wait(ended.done, 60.0)
            assert ended.result().status == SUCCEEDED
        pose = got["odom"][-1].pose.pose
        assert (pose.position.x, pose.position.y) == pytest.approx((1.0, 0.0), abs=0.1)
        yaw = 2.0 * degrees(atan2(pose.orientation.z, pose.orientation.w))
        assert yaw == pytest.approx(90.0, abs=6.0)  # 5 when it was judged
        client.destroy()


def test_the_bridge_of_a_session_ends_with_it(tmp_path, monkeypatch):
    from nav_msgs.msg import Odometry as RosOdometry

    watcher = Watcher(odom=("/odom", RosOdometry))
    with closing(watcher), session(tmp_path, monkeypatch, "hover"):
        watcher.wait(lambda: len(watcher.got["odom"]) > 100, 30.0)
        assert watcher.call("/cloudrc/acknowledge").message
