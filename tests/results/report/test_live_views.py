# SPDX-License-Identifier: Apache-2.0

"""Messages for Foxglove from cloud's records during a flight."""

from rosbags.typesys import Stores, get_typestore

from cloudrc.results.record.topics import VIEWS
from cloudrc.results.report.live_views import REPEAT_NS, LiveViews
from cloudrc.wire.messages import UPRIGHT, GuardState
from cloudrc.wire.records import FrameKept, ScanTaken
from tests.support.told import told

STORE = get_typestore(Stores.ROS2_KILTED)


def topics(views, record):
    return [topic for topic, _, _ in views.of(record)]


def test_telemetry_moves_the_robot_and_shows_the_guard():
    views = LiveViews([])
    found = {topic: data for topic, _, data in views.of(told(5, GuardState.GROUND))}
    assert found.keys() == {"/odometry", "/telemetry", "/tf", "/guard", "/scene"}
    (frame,) = STORE.deserialize_cdr(found["/tf"], VIEWS["/tf"]).transforms
    place = frame.transform.translation
    assert (frame.child_frame_id, place.x, place.y, place.z) == ("base_link", 1.0, 2.0, 3.0)


def test_the_guard_comes_at_a_change_and_with_the_scene_once_a_second():
    views = LiveViews([])
    list(views.of(told(0, GuardState.GROUND)))
    assert "/guard" not in topics(views, told(10, GuardState.GROUND))
    changed = topics(views, told(20, GuardState.TRACK))
    assert ("/guard" in changed, "/scene" in changed) == (True, False)
    assert {"/guard", "/scene"} <= set(topics(views, told(REPEAT_NS, GuardState.TRACK)))


def test_a_scan_comes_with_the_frame_of_its_scanner():
    scan = ScanTaken(5, 1, 0, -0.5, 0.25, 0.125, 10.0, [1.0, 2.0])
    views = LiveViews([], ((0.1, 0.0, 0.2), UPRIGHT))
    found = {topic: data for topic, _, data in views.of(scan)}
    shown = STORE.deserialize_cdr(found["/scan"], "sensor_msgs/msg/LaserScan")
    assert (shown.header.frame_id, shown.ranges.tolist()) == ("lidar", [1.0, 2.0])
    assert (shown.angle_min, shown.angle_max, shown.angle_increment) == (-0.5, -0.25, 0.25)
    (frame,) = STORE.deserialize_cdr(found["/tf"], VIEWS["/tf"]).transforms
    assert (frame.header.frame_id, frame.child_frame_id) == ("base_link", "lidar")
    assert frame.transform.translation.x == 0.1
    assert topics(LiveViews([]), scan) == ["/scan"]


def test_a_picture_comes_with_the_frame_of_its_camera():
    views = LiveViews([], camera=((0.1, 0.0, 0.0), (0.5, -0.5, 0.5, -0.5)))
    found = {topic: data for topic, _, data in views.of(FrameKept(5, "jpeg", b"abc"))}
    shown = STORE.deserialize_cdr(found["/camera"], "sensor_msgs/msg/CompressedImage")
    assert (shown.header.frame_id, shown.format) == ("camera", "jpeg")
    assert bytes(shown.data) == b"abc"
    (frame,) = STORE.deserialize_cdr(found["/tf"], VIEWS["/tf"]).transforms
    assert (frame.header.frame_id, frame.child_frame_id) == ("base_link", "camera")
