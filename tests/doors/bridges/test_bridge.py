# SPDX-License-Identifier: Apache-2.0

"""What the bridge of a flight to ROS 2 publishes and asks for, without a ROS."""

import time
from math import inf, nan, pi
from xml.etree import ElementTree

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from cloudrc.config.disturbances import SensorsConfig
from cloudrc.doors.bridges.ros2.description import RobotFrames, covariances, urdf
from cloudrc.doors.bridges.ros2.health import FlightHealth
from cloudrc.doors.bridges.ros2.mission import MissionNews, Navigation
from cloudrc.doors.bridges.ros2.requests import RosRequests
from cloudrc.doors.console.steering import Steering
from cloudrc.physics.geometry.scene import Scene
from cloudrc.physics.geometry.shapes import Shapes, Surface
from cloudrc.results.record.live import (
    ERROR,
    OK,
    STALE,
    WARN,
    HealthStatus,
    encode_diagnostics,
    encode_odometry,
    encode_text,
    encode_transforms,
)
from cloudrc.results.report.markers import encode_markers, path_shape, scene_shapes
from cloudrc.wire.messages import UPRIGHT, ZERO, GuardState
from cloudrc.wire.records import Arrival
from tests.doors.console.conftest import FakeApi
from tests.support.told import told

STORE = get_typestore(Stores.ROS2_KILTED)
LEFT = (2**-0.5, 0.0, 0.0, 2**-0.5)
ANY = (0.0, 0.0, 0.0, 0.0)
"""Orientation: turned by 90 degrees to the left."""


class Asking:
    """Requests of nodes for a robot, and what came of them."""

    def __init__(self, *, planar=False, heading="free", **options):
        self.said = []
        self.api = FakeApi()
        self.steering = Steering(self.api)
        options |= {"planar": planar, "heading": heading}
        self.requests = RosRequests(self.steering, self.said.append, **options)

    def velocity(self, now=0.0):
        self.requests.pass_on()
        return self.steering.velocity(now)


@pytest.mark.parametrize(
    ("options", "z", "goal", "said"),
    [
        ({}, 1.5, {"position_m": [1.0, 2.0, 1.5], "yaw_deg": 90.0}, "(1, 2, 1.5)"),
        ({}, 0.0, {"position_m": [1.0, 2.0, 1.7], "yaw_deg": 90.0}, "(1, 2, 1.7)"),
        (
            {"heading": "velocity", "planar": True},
            0.0,
            {"position_m": [1.0, 2.0], "yaw_deg": 90.0},
            "(1, 2)",
        ),
    ],
)
def test_a_goal_is_a_goto_with_its_yaw_which_on_the_ground_keeps_the_height(options, z, goal, said):
    """RViz sends goals on the ground."""
    asking = Asking(**options)
    asking.requests.see((0.0, 0.0, 1.7), UPRIGHT)
    asking.requests.go_to("map", (1.0, 2.0, z), LEFT)
    assert asking.api.posted == [("/v1/goto", goal)]
    assert asking.said == [f"going to {said}"]


@pytest.mark.parametrize(
    ("frame", "flown"),
    [("", (0.0, 0.5)), ("drone1/base_link", (0.0, 0.5)), ("world", (0.5, 0.0)), ("map", (0.5, 0))],
)
def test_a_velocity_is_turned_from_the_base_to_the_world(frame, flown):
    asking = Asking(frames=RobotFrames("drone1/"))
    asking.requests.see(ZERO, LEFT)
    asking.requests.drive(frame, (0.5, 0.0, 0.1), 0.0)
    assert asking.velocity() == pytest.approx((*flown, 0.1))
    assert asking.said == []


@pytest.mark.parametrize(
    ("frame", "heading", "velocity", "turn"),
    [
        ("", "velocity", (0.5, 0.0, 0.0), -0.2),
        ("map", "free", (0.0, -0.5, 0.0), -0.2),
        ("", "fixed", (0.0, 0.5, 0.0), None),
    ],
)
def test_a_turn_is_asked_for_in_the_frame_of_the_heading(frame, heading, velocity, turn):
    asking = Asking(planar=True, heading=heading)
    asking.requests.see(ZERO, LEFT)
    for _ in range(3):
        asking.requests.drive(frame, (0.5, 0.0, 0.3), -0.2)
    assert asking.velocity() == pytest.approx(velocity)
    assert asking.steering._turn == turn
    ignored = ["angular.z is ignored" in text for text in asking.said]
    assert ignored == [True] * (heading == "fixed")


@pytest.mark.parametrize(
    ("options", "frame", "number", "why"),
    [
        ({}, "odom", 1.0, "unknown frame 'odom'"),
        ({}, "", inf, "a number is not finite"),
        ({"observes": True}, "", 1.0, ""),
    ],
)
def test_a_request_that_cannot_be_meant_is_refused_in_one_line(options, frame, number, why):
    asking = Asking(**options)
    asking.requests.go_to(frame, (number, 0.0, 1.0), UPRIGHT)
    asking.requests.drive(frame, (number, 0.0, 0.0), 0.0)
    assert (asking.velocity(), asking.api.posted) == (ZERO, [])
    goal, velocity = (text.partition(";")[0] for text in asking.said)
    assert goal.startswith(f"goal_pose: {why}")
    assert velocity.startswith(f"cmd_vel: {why}")


def test_a_goal_whose_orientation_is_not_finite_is_refused():
    asking = Asking()
    asking.requests.go_to("", (1.0, 0.0, 1.0), (nan, 0.0, 0.0, 0.0))
    assert asking.said == ["goal_pose: a number is not finite"]


def test_a_bridge_that_observes_stops_nothing():
    accepted, words = (asking := Asking(observes=True)).requests.serve("estop")
    assert (accepted, asking.api.posted, "--observe" in words) == (False, [], True)


@pytest.mark.parametrize("name", ["hold", "estop", "acknowledge"])
def test_a_service_is_a_request_to_teleop(name):
    asking = Asking()
    assert asking.requests.serve(name)[0]
    assert asking.api.posted == [(f"/v1/{name}", None)]


def test_cancel_needs_a_mission():
    asking = Asking()
    asking.api.answers["/v1/state"] = {"mission": None}
    assert asking.requests.serve("cancel") == (False, "no mission is under way")
    asking.api.answers["/v1/state"] = {"mission": {"id": "m3"}}
    assert asking.requests.serve("cancel")[0]
    assert asking.api.posted == [("/v1/missions/m3/cancel", None)]


def test_a_refusal_of_teleop_is_the_answer_and_an_emergency_stop_is_asked_for_again():
    asking = Asking()
    asking.api.refused = dict.fromkeys(("/v1/hold", "/v1/estop"), "not now")
    assert asking.requests.serve("hold") == (False, "not now")
    assert not asking.steering._stops.is_set()
    assert asking.requests.serve("estop") == (False, "not now")
    assert asking.steering._stops.is_set()


def test_the_mission_and_the_last_refused_goal_are_news():
    asking = Asking()
    news = MissionNews(asking.api, asking.requests)
    mission = {"id": "m1", "name": "pipes", "state": "flying", "waypoint": 1, "waypoints": 7}
    mission |= {"reached": [{}], "verdict": None}
    assert news.look({}) is None
    flying = news.look({"mission": mission})
    assert (flying.level, flying.values["waypoints reached"]) == (OK, "1 of 7")
    assert news.look({"mission": mission}) is None, "nothing new"
    asking.api.refused["/v1/goto"] = "behind a wall"
    asking.requests.go_to("map", (9.0, 0.0, 1.0), UPRIGHT)
    values = news.look({"mission": mission}).values
    assert values["refused goal"] == "(9.00, 0.00, 1.00) m in map"
    assert values["refused because"] == "behind a wall"
    verdict = {"outcome": "failure", "failures": [{"code": "timed_out", "text": "too slow"}]}
    asking.api.answers["/v1/missions/m1"] = {**mission, "state": "failed", "verdict": verdict}
    failed = news.look({"mission": None})
    assert (failed.level, "too slow" in failed.text) == (ERROR, True)


class Pilot(Asking):
    """A robot that flies to a goal in a mission with one state after the other."""

    def __init__(self, states):
        super().__init__()
        self.states, self.fed, self.wants_end = states, [], False
        self.api.get = self.get

    def get(self, path):
        verdict = {"outcome": "failure", "failures": [{"code": "guard", "text": "hit a pipe"}]}
        mission = {"id": "m1", "state": self.states[0], "verdict": verdict}
        del self.states[: len(self.states) > 1]
        return {"mission": mission} if path == "/v1/state" else mission

    def fly(self, goal=(1.0, 0.0, 1.0), wxyz=UPRIGHT):
        def tell(*given):
            self.fed.append(given)
            self.requests.see((0.8 + 0.1 * len(self.fed), 0.0, 1.0), UPRIGHT)

        navigation = Navigation(self.api, self.requests)
        return navigation.fly(("map", goal, wxyz), lambda: self.wants_end, tell)


def test_to_navigate_is_to_fly_a_mission_to_its_end(monkeypatch):
    monkeypatch.setattr(time, "sleep", lambda _: None)
    pilot = Pilot(["starting", "flying", "done"])
    assert pilot.fly() == ""
    assert len(pilot.fed) == 3
    assert pilot.fed[1][:2] == ((0.9, 0.0, 1.0), pytest.approx(0.1))
    assert "hit a pipe" in Pilot(["starting", "failed"]).fly()


def test_a_goal_beside_a_held_mission_ends_there_and_a_cancelled_one_here(monkeypatch):
    monkeypatch.setattr(time, "sleep", lambda _: None)
    monkeypatch.setattr("cloudrc.doors.bridges.ros2.mission.DWELL", 0.0)
    assert Pilot(["held"]).fly() == ""
    assert "resumed" in Pilot(["held", "flying"]).fly((9.0, 0.0, 1.0))
    held, flying = Pilot(["held"]), Pilot(["flying"])
    for pilot, path in ((held, "/v1/goto"), (flying, "/v1/missions/m1/cancel")):
        pilot.wants_end = True
        assert pilot.fly((9.0, 0.0, 1.0)) == "cancelled"
        assert pilot.api.posted[-1][0] == path


@pytest.mark.parametrize(("wxyz", "ends"), [(UPRIGHT, True), (LEFT, False)])
def test_a_goal_beside_a_held_mission_ends_with_its_heading(monkeypatch, wxyz, ends):
    monkeypatch.setattr(time, "sleep", lambda _: None)
    monkeypatch.setattr("cloudrc.doors.bridges.ros2.mission.DWELL", 0.0)
    pilot = Pilot(["held", *["held"] * 4, "flying"])
    assert (pilot.fly(wxyz=wxyz) == "") == ends


@pytest.mark.parametrize(("wxyz", "goes"), [(UPRIGHT, True), (ANY, True), (LEFT, False)])
def test_a_robot_that_cannot_turn_answers_so_when_the_goal_comes(wxyz, goes):
    asking = Asking(heading="fixed")
    why = asking.requests.go_to("map", (1.0, 2.0, 1.0), wxyz)
    assert ("holds the yaw at 0" in why) is not goes
    goal = ("/v1/goto", {"position_m": [1.0, 2.0, 1.0]})
    assert asking.api.posted == [goal] * goes


def test_a_refused_goal_is_not_flown():
    pilot = Pilot(["done"])
    pilot.api.refused["/v1/goto"] = "outside the fence"
    assert pilot.fly() == "outside the fence"
    assert pilot.fed == []


def test_the_description_has_a_box_for_each_part_of_the_robot():
    corners = np.array([[-0.2, -0.1, 0.0], [0.2, 0.1, 0.05], [0.0, 0.0, 0.0]])
    part = Surface("", corners, np.array([[0, 1, 2]], np.int32))
    text = urdf("rover", RobotFrames("drone1/", rep_105=True), [part])
    robot = ElementTree.fromstring(text)
    assert robot.find("link").get("name") == "drone1/base_link"
    assert robot.find(".//visual//box").get("size") == "0.4 0.2 0.05"
    assert robot.find(".//visual/origin").get("xyz") == "0 0 0.025"


def test_an_odometry_says_how_exact_it_is():
    errors = SensorsConfig(position_noise_m=0.1, attitude_noise_deg=180 / pi, rate_noise_radps=0.2)
    data = encode_odometry(0, ZERO, UPRIGHT, ZERO, ZERO, "b", "odom", covariances(errors))
    odometry = STORE.deserialize_cdr(data, "nav_msgs/msg/Odometry")
    assert (odometry.header.frame_id, odometry.child_frame_id) == ("odom", "b")
    found = [np.diag(each.covariance.reshape(6, 6)) for each in (odometry.pose, odometry.twist)]
    assert np.concatenate(found) == pytest.approx([0.01] * 3 + [1.0] * 3 + [0.0] * 3 + [0.04] * 3)


def health(*records, now_ns=1_000_000_000, dropped=0):
    judge = FlightHealth()
    for record in records:
        judge.take(record)
    return judge.report(now_ns, dropped)


@pytest.mark.parametrize(
    ("guard", "level"),
    [("GROUND", OK), ("TRACK", OK), ("HOLD", WARN), ("LAND", ERROR), ("ESTOP", ERROR)],
)
def test_the_robot_is_as_well_as_its_guard(guard, level):
    sent = told(900_000_000, GuardState[guard])
    robot = health(sent)[0]
    assert (robot.level, robot.values["guard"]) == (level, guard)
    assert robot.values["telemetry age"] == "100.0 ms"
    assert health(sent, now_ns=3_000_000_000)[0].level == STALE


def test_loss_is_counted_as_everywhere_and_delays_are_those_of_the_last_seconds():
    times = range(0, 10_000_000_000, 10_000_000)
    arrivals = [Arrival(t, True, 1, t // 10_000_000, 0.04, True) for t in times if t % 40_000_000]
    link = health(Arrival(0, True, 7, 1, 9.0, True), *arrivals, now_ns=times[-1])[1]
    assert link.values["uplink loss"] == "24.9 %"
    assert link.values["uplink delay, max"] == "40.0 ms"
    assert health(*arrivals, now_ns=times[-1] + 600_000_000)[1].level == ERROR


def test_ros_reads_health_guard_and_frames():
    statuses = [HealthStatus(WARN, "link", "slow", {"loss": "1 %"})]
    data = encode_diagnostics(2_000_000_003, statuses, "drone1")
    message = STORE.deserialize_cdr(data, "diagnostic_msgs/msg/DiagnosticArray")
    (status,) = message.status
    assert (message.header.stamp.nanosec, status.level, status.hardware_id) == (3, WARN, "drone1")
    assert (status.values[0].key, status.values[0].value) == ("loss", "1 %")
    assert STORE.deserialize_cdr(encode_text("HOLD"), "std_msgs/msg/String").data == "HOLD"
    data = encode_transforms(7, {"drone1/base_link": ((1.0, 2.0, 3.0), LEFT)})
    (moved,) = STORE.deserialize_cdr(data, "tf2_msgs/msg/TFMessage").transforms
    assert (moved.header.frame_id, moved.child_frame_id) == ("world", "drone1/base_link")
    assert (moved.transform.translation.z, moved.transform.rotation.z) == (3.0, LEFT[3])


@pytest.mark.parametrize(
    ("frames", "parents"),
    [
        (RobotFrames(), {"map": "world", "lidar": "base_link"}),
        (RobotFrames("a/", rep_105=True), {"a/odom": "map", "a/lidar": "a/base_link"}),
    ],
)
def test_scanner_and_camera_are_at_rest_in_the_base_and_the_world_in_the_map(frames, parents):
    pose = (0.1, 0.0, 0.2), UPRIGHT
    tree = frames.at_rest(pose)
    assert {child: parent for parent in tree for child in tree[parent]} == parents
    assert tree[frames.base][frames.lidar] == pose
    assert frames.base not in frames.at_rest(None)
    assert frames.at_rest(None, pose)[frames.base] == {frames.camera: pose}


def test_markers_move_with_the_robots_frames_and_the_scene_stays():
    corners, faces = np.eye(3), np.array([[0, 1, 2]], np.int32)
    bodies = Shapes((Surface("", corners, faces),), (Surface("box", corners, faces),))
    path = path_shape("flown", [ZERO, (1.0, 0.0, 0.0)])
    shapes = [*scene_shapes(bodies, Scene("empty"), "drone1/"), path]
    data = encode_markers(0, shapes)
    markers = STORE.deserialize_cdr(data, "visualization_msgs/msg/MarkerArray").markers
    assert [(marker.ns, marker.header.frame_id) for marker in markers] == [
        ("robot", "drone1/base_link"),
        ("estimate", "drone1/estimate"),
        ("setpoint", "drone1/setpoint"),
        ("box", "world"),
        ("flown", "world"),
    ]
    assert len(markers[-1].points) == 2
