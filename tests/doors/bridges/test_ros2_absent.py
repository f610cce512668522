# SPDX-License-Identifier: Apache-2.0

"""What ROS 2 needs, and its messages, without a ROS."""

import sys
from math import pi

import pytest
from rosbags.typesys import Stores, get_typestore

from cloudrc.base import plugins
from cloudrc.base.errors import BadInputError
from cloudrc.config.load import load_experiment
from cloudrc.doors.cli.main import main
from cloudrc.flight.experiment import check_mode
from cloudrc.results.record.live import (
    decode_stamped_twist,
    encode_clock,
    encode_odometry,
    encode_pose,
    encode_span,
)

STORE = get_typestore(Stores.ROS2_KILTED)
"""The messages of another distribution than the one that cloudrc encodes with."""


def test_without_ros_a_flight_is_refused_before_a_folder_is_made(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "rclpy", None)
    words = ["run", "paper", "--set", "cloud.controller=ros2", "--out", str(tmp_path / "run")]
    assert main([*words, "--mode", "virtual"]) == 3
    (error,) = capsys.readouterr().err.splitlines()
    assert "source /opt/ros" in error
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("lack", ["entry point", "module"])
def test_without_the_bridge_a_line_names_its_extra(lack, tmp_path, monkeypatch, capsys):
    if lack == "module":
        monkeypatch.setitem(sys.modules, "cloudrc.doors.bridges.ros2.transport", None)
    else:
        monkeypatch.syspath_prepend(tmp_path)  # another search path is searched anew
        monkeypatch.setattr(plugins, "_declared", lambda path: "")
    assert main(["run", "paper", "--mode", "virtual", "--set", "cloud.controller=ros2"]) == 3
    (error,) = capsys.readouterr().err.splitlines()
    assert "transport" in error
    assert "pip install 'cloudrc[policy]'" in error


def test_a_node_neither_plans_nor_flies_in_a_cluster():
    with pytest.raises(BadInputError, match="'ros2' cannot plan"):
        load_experiment("fast", ["cloud.controller=ros2", "cloud.plan_s=0.5"])
    with pytest.raises(BadInputError, match="virtual or local"):
        check_mode(load_experiment("paper", ["cloud.controller=ros2"]), "cluster")


def test_ros_reads_an_odometry_with_the_twist_in_its_child_frame():
    turned = (2**-0.5, 0.0, 0.0, 2**-0.5)  # by 90 degrees to the left
    data = encode_odometry(3_000_000_005, (1.0, 2.0, 3.0), turned, (1.0, 0.0, 0.5), (0.1, 0.2, 0.3))
    message = STORE.deserialize_cdr(data, "nav_msgs/msg/Odometry")
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (3, 5)
    assert (message.header.frame_id, message.child_frame_id) == ("world", "base_link")
    assert message.pose.pose.position.y == 2.0
    linear = message.twist.twist.linear
    assert (linear.x, linear.y, linear.z) == pytest.approx((0.0, -1.0, 0.5))
    assert message.twist.twist.angular.z == 0.3


def test_ros_reads_setpoint_and_clock():
    pose = STORE.deserialize_cdr(encode_pose(7, (1, 2, 3), pi), "geometry_msgs/msg/PoseStamped")
    assert (pose.header.stamp.nanosec, pose.header.frame_id) == (7, "world")
    assert (pose.pose.position.z, pose.pose.orientation.z) == (3.0, 1.0)
    clock = STORE.deserialize_cdr(encode_clock(2_000_000_001), "rosgraph_msgs/msg/Clock")
    assert (clock.clock.sec, clock.clock.nanosec) == (2, 1)


@pytest.mark.parametrize(
    ("stamp_ns", "begin"), [(1_500_000_000, (1, 250_000_000)), (0, (-1, 750_000_000))]
)
def test_ros_reads_a_delay_as_a_time_before_the_stamp(stamp_ns, begin):
    message = STORE.deserialize_cdr(encode_span(stamp_ns, 0.25), "sensor_msgs/msg/TimeReference")
    assert (message.time_ref.sec, message.time_ref.nanosec) == begin
    assert message.header.stamp.nanosec == stamp_ns % 10**9


def test_a_command_of_ros_is_read():
    types = STORE.types
    time = types["builtin_interfaces/msg/Time"](1, 9)
    vector = types["geometry_msgs/msg/Vector3"]
    twist = types["geometry_msgs/msg/Twist"](vector(1.0, 2.0, 3.0), vector(0.0, 0.0, 0.25))
    header = types["std_msgs/msg/Header"](time, "base_link")
    message = types["geometry_msgs/msg/TwistStamped"](header, twist)
    data = bytes(STORE.serialize_cdr(message, "geometry_msgs/msg/TwistStamped"))
    assert decode_stamped_twist(data) == (1_000_000_009, "base_link", (1.0, 2.0, 3.0), 0.25)
