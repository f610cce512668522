# SPDX-License-Identifier: Apache-2.0

"""A flight on ROS 2: publish what cloud knows of the robot, and take what nodes ask it for.

Messages are published as CDR bytes, which is faster than by rclpy's Python objects. The stamps are
times of the wall clock, as those of other nodes.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Collection
from importlib.util import find_spec
from math import dist
from typing import Any, NamedTuple

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped, Twist, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.type_support import check_for_type_support
from sensor_msgs.msg import CompressedImage, LaserScan
from std_msgs.msg import String
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from cloudrc.doors.bridges.ros2.description import Covariances, RobotFrames
from cloudrc.doors.bridges.ros2.health import FlightHealth
from cloudrc.doors.bridges.ros2.mission import MissionNews, Navigation
from cloudrc.doors.bridges.ros2.own_node import NEWEST, QUEUED, OwnNode
from cloudrc.doors.bridges.ros2.requests import RosRequests
from cloudrc.doors.console.steering import VERBS, Steering
from cloudrc.flight.pod.readers import RecordReader
from cloudrc.physics.geometry.shapes import Pose
from cloudrc.results.record.live import (
    EXACT,
    encode_diagnostics,
    encode_odometry,
    encode_status,
    encode_text,
    encode_transforms,
    encode_tree,
    frames_of,
)
from cloudrc.results.record.ros import pack_picture, pack_scan
from cloudrc.results.record.topics import TOPICS
from cloudrc.results.report.markers import GOAL, encode_markers, path_shape
from cloudrc.wire.messages import ZERO, GuardState, Quaternion, Telemetry, Vector
from cloudrc.wire.records import Control, FrameKept, Record, ScanTaken, TelemetrySent

KEPT = QoSProfile(
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
"""QoS of what changes rarely: a late subscriber gets the newest message, too."""
STAMPED = "geometry_msgs/msg/TwistStamped"
PERIOD = 1.0
"""Time between two messages about health and path [s]."""
WAKE = 0.05
"""Longest wait for records [s]."""
THREADS = 4
"""Number of threads that serve requests: an emergency stop does not wait for another request."""
TRAIL_STEP, TRAIL_MAX = 0.05, 1000
"""Shortest distance between two points of the flown path [m], and their largest number."""
JUMP = 0.5
"""Distance between two positions above which a new path begins: the robot was set back [m]."""


def load_messages() -> None:
    """Load the code of all messages; raise an exception if it is not for this ROS or Python."""
    own = Odometry, LaserScan, CompressedImage, PoseStamped, Twist, String, Trigger, MarkerArray
    for kind in (*own, DiagnosticArray):
        check_for_type_support(kind)


class Shown(NamedTuple):
    """What the bridge publishes of the robot that does not change."""

    frames: RobotFrames
    scene: bytes  # markers of robot and scene, a visualization_msgs/MarkerArray
    description: str  # URDF
    covariances: Covariances = (EXACT, EXACT)  # of the measured pose and twist
    navigates: bool = True  # whether it serves Nav2's action
    scanner: Pose | None = None  # of the robot's scanner in the frame of its base; None: none
    camera: Pose | None = None  # of its camera, likewise


class RosBridge(OwnNode):
    """The node of a flight."""

    def __init__(
        self,
        namespace: str,
        shown: Shown,
        steering: Steering,
        requests: RosRequests,
        tell: Callable[[str], None],
    ) -> None:
        """Open the node below `namespace`; `tell` gets words for the user."""
        super().__init__("cloudrc_bridge", namespace)
        self._robot = namespace.strip("/")
        self._frames, self._markers = shown.frames, shown.scene
        self._scanner, self._camera = shown.scanner, shown.camera
        self._covariances = shown.covariances
        self._steering, self._requests = steering, requests
        self._health, self._news = FlightHealth(), MissionNews(steering.api, requests)
        self._guard: GuardState | None = None
        self._trail: deque[Vector] = deque(maxlen=TRAIL_MAX)
        self._watchers = 0  # subscriptions to the scene
        self._offset_ns, self._slip_ns = _wall_offset_ns(), 0
        publisher = self.node.create_publisher
        self._odometry = publisher(Odometry, "odom", QUEUED)
        self._scans = publisher(LaserScan, "scan", QUEUED) if shown.scanner else None
        compressed = "camera/compressed"  # as image_transport names it
        self._images = publisher(CompressedImage, compressed, QUEUED) if shown.camera else None
        self._guards = publisher(String, "cloudrc/guard", KEPT)
        self._scene = publisher(MarkerArray, "cloudrc/scene", KEPT)
        self._path = publisher(MarkerArray, "cloudrc/path", KEPT)
        self._diagnostics = publisher(DiagnosticArray, "/diagnostics", QUEUED)
        self._mission = publisher(DiagnosticStatus, "cloudrc/mission", KEPT)
        publisher(String, "robot_description", KEPT).publish(encode_text(shown.description))
        self._transforms = self._open_transforms(tell)
        self._group = ReentrantCallbackGroup()
        self._kind: Any = Twist
        self._take_commands()
        self.node.create_subscription(
            PoseStamped, "goal_pose", self._go_to, NEWEST, callback_group=self._group
        )
        for name in VERBS:
            self.node.create_service(
                Trigger, f"cloudrc/{name}", self._server(name), callback_group=self._group
            )
        if shown.navigates:
            self._navigator = self._serve_navigation(tell)
        self._ended = False
        self._listener = threading.Thread(target=self._listen, daemon=True)
        tell(f"{self._odometry.topic_name} and more topics in {self.domain}")

    def run(self, reader: RecordReader, has_ended: Callable[[], bool]) -> None:
        """Publish until `has_ended()` is true."""
        self._listener.start()
        due = time.monotonic()
        while True:
            for record in reader.take(WAKE):
                self._publish(record)
            self._requests.pass_on()
            if status := self._news.look(self._steering.state):
                self._mission.publish(encode_status(status, self._robot))
            if (now := time.monotonic()) >= due:
                due = now + PERIOD
                if has_ended():
                    return
                self._publish_rest(reader.dropped)

    def close(self) -> None:
        """Leave ROS."""
        self._ended = True
        if self._listener.is_alive():
            self._listener.join()
        super().close()

    def _open_transforms(self, tell: Callable[[str], None]) -> Any:
        """Open /tf and publish the static frames; return None where ROS lacks their messages."""
        if find_spec("tf2_msgs") is None:
            tell("/tf and /tf_static are left out: this ROS 2 has no tf2_msgs")
            return None
        from tf2_msgs.msg import TFMessage

        self._static = self.node.create_publisher(TFMessage, "/tf_static", KEPT)
        tree = self._frames.at_rest(self._scanner, self._camera)
        self._static.publish(encode_tree(time.time_ns(), tree))  # a late node gets one message
        return self.node.create_publisher(TFMessage, "/tf", QUEUED)

    def _publish(self, record: Record) -> None:
        self._health.take(record)
        if isinstance(record, TelemetrySent):
            self._publish_telemetry(record.telemetry)
        elif isinstance(record, ScanTaken) and self._scans is not None:
            stamp_ns, *values = TOPICS["/scan"].row(record)
            stamp_ns += self._slip_ns + self._offset_ns
            self._scans.publish(pack_scan((stamp_ns, *values), self._frames.lidar))
        elif isinstance(record, FrameKept) and self._images is not None:
            stamp_ns, *values = TOPICS["/camera"].row(record)
            stamp_ns += self._slip_ns + self._offset_ns
            self._images.publish(pack_picture((stamp_ns, *values), self._frames.camera))
        elif isinstance(record, Control) and self._transforms is not None:
            stamp_ns = record.stamp_ns + self._offset_ns
            frames = frames_of(record, self._frames.prefix)
            self._transforms.publish(encode_transforms(stamp_ns, frames))

    def _publish_telemetry(self, telemetry: Telemetry) -> None:
        stamp_ns, position, orientation, velocity, rates = telemetry.odometry
        self._slip_ns = telemetry.slip_ns
        stamp_ns += telemetry.slip_ns + self._offset_ns
        base, odom = self._frames.base, self._frames.odom
        pose = position, orientation
        self._odometry.publish(
            encode_odometry(stamp_ns, *pose, velocity, rates, base, odom, self._covariances)
        )
        if self._transforms is not None:
            self._transforms.publish(encode_transforms(stamp_ns, {base: pose}, odom))
        if telemetry.guard is not self._guard:
            self._guard = telemetry.guard
            self._guards.publish(encode_text(telemetry.guard.name))
        self._requests.see(*pose)
        self._follow(position)

    def _follow(self, position: Vector) -> None:
        """Add a position to the flown path."""
        moved = dist(position, self._trail[-1]) if self._trail else JUMP
        if moved > JUMP:
            self._trail.clear()
        if moved > TRAIL_STEP:
            self._trail.append(position)

    def _publish_rest(self, dropped: int) -> None:
        """Publish health and path, and the scene if somebody new looks at it."""
        self._offset_ns = _wall_offset_ns()  # the wall clock may have been set
        now_ns = time.monotonic_ns()
        statuses = self._health.report(now_ns, dropped)
        stamp_ns = now_ns + self._offset_ns
        self._diagnostics.publish(encode_diagnostics(stamp_ns, statuses, self._robot))
        if self._guard is not None:  # a plain subscriber gets no old message
            self._guards.publish(encode_text(self._guard.name))
        watchers, before = self._scene.get_subscription_count(), self._watchers
        self._watchers = watchers
        if watchers > before:
            self._scene.publish(self._markers)
        if self._path.get_subscription_count():
            flown, route = _line(self._trail), _line(self._steering.route)
            shapes = [path_shape("flown", flown), path_shape("route", route, GOAL)]
            self._path.publish(encode_markers(0, shapes))
        self._follow_type()

    def _take_commands(self) -> None:
        self._commands = self.node.create_subscription(
            self._kind, "cmd_vel", self._drive, NEWEST, callback_group=self._group
        )

    def _follow_type(self) -> None:
        """Take commands of the type that nodes publish, with or without a stamp.

        The executor may still wait for a subscription that is destroyed: the next call makes the
        new one.
        """
        if self._commands is None:
            self._take_commands()
        infos = self.node.get_publishers_info_by_topic(self.node.resolve_topic_name("cmd_vel"))
        types = {info.topic_type for info in infos}
        kind = TwistStamped if STAMPED in types else Twist
        if types and kind is not self._kind:
            self.node.destroy_subscription(self._commands)
            self._commands, self._kind = None, kind

    def _listen(self) -> None:
        executor = MultiThreadedExecutor(THREADS, context=self.context)
        executor.add_node(self.node)
        while not self._ended:
            executor.spin_once(timeout_sec=WAKE)
        executor.shutdown()

    def _server(self, name: str) -> Callable[[Any, Any], Any]:
        def serve(request: Any, answer: Any) -> Any:
            answer.success, answer.message = self._requests.serve(name)
            return answer

        return serve

    def _serve_navigation(self, tell: Callable[[str], None]) -> Any:
        """Serve Nav2's action, where ROS has its messages."""
        if find_spec("nav2_msgs") is None:
            tell("the action navigate_to_pose is left out: this ROS 2 has no nav2_msgs")
            return None
        from cloudrc.doors.bridges.ros2.navigate import serve_navigation

        navigation = Navigation(self._steering.api, self._requests)
        return serve_navigation(self.node, navigation, read_goal, self._group)

    def _go_to(self, goal: PoseStamped) -> None:
        self._requests.go_to(*read_goal(goal))

    def _drive(self, command: Any) -> None:
        frame, twist = "", command
        if isinstance(command, TwistStamped):
            frame, twist = command.header.frame_id, command.twist
        linear = (twist.linear.x, twist.linear.y, twist.linear.z)
        self._requests.drive(frame, linear, twist.angular.z)


def read_goal(goal: PoseStamped) -> tuple[str, Vector, Quaternion]:
    """Return frame, position [m] and orientation [1] of a goal."""
    place, turn = goal.pose.position, goal.pose.orientation
    wxyz = (turn.w, turn.x, turn.y, turn.z)
    return goal.header.frame_id, (place.x, place.y, place.z), wxyz


def _line(points: Collection[Vector]) -> Collection[Vector]:
    """Return the points of a line; fewer than two become an invisible one, which hides the last."""
    return points if len(points) > 1 else (ZERO, ZERO)


def _wall_offset_ns() -> int:
    """Return the wall clock's time minus that of cloud's clock [ns]."""
    return time.time_ns() - time.monotonic_ns()
