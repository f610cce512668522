# SPDX-License-Identifier: Apache-2.0

"""ROS messages contain the values of the rows, in the conventions of ROS."""

import math

import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from cloudrc.results.record.ros import STORE, decode, definition, encode, is_known, type_hash
from cloudrc.results.record.topics import TOPICS


def standard(topic, stamp_ns, values):
    """Encode a row, and decode it as a ROS 2 tool that knows only the standard types."""
    data = encode(TOPICS[topic], (stamp_ns, *values))
    return get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr(data, TOPICS[topic].ros_type)


def xyz(vector):
    return vector.x, vector.y, vector.z


def test_rows_are_converted_to_the_conventions_of_ros():
    half = math.sqrt(0.5)
    # A quarter turn to the left: forward is the world's y, so a motion along x is to the right.
    values = ((1.0, 2.0, 3.0), (half, 0.0, 0.0, half), (4.0, 1.0, 0.5), (0.1, 0.2, 0.3))
    message = standard("/ground_truth", 2_500_000_000, values)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (2, 500_000_000)
    assert (message.header.frame_id, message.child_frame_id) == ("world", "base_link")
    pose, twist = message.pose.pose, message.twist.twist
    assert xyz(pose.position) == (1.0, 2.0, 3.0)
    assert (*xyz(pose.orientation), pose.orientation.w) == (0.0, 0.0, half, half)
    assert xyz(twist.linear) == pytest.approx((1.0, -4.0, 0.5), abs=1e-12)
    assert xyz(twist.angular) == (0.1, 0.2, 0.3)
    predicted = standard("/estimated_odometry", 0, values[:3]).twist.twist
    assert math.isnan(predicted.angular.z), "it is not predicted"
    fault = TOPICS["/fault"]
    assert decode(fault, encode(fault, (0, "bad_name", "file \udcff", "")))[2] == "file ?"
    twist = standard("/cmd_vel", 1, ((1.0, 2.0, 3.0), 0.4)).twist
    assert (xyz(twist.linear), xyz(twist.angular)) == ((1.0, 2.0, 3.0), (0.0, 0.0, 0.4))


EXAMPLES = {
    "int": -(2**40),
    "float": 0.125,  # also in single precision
    "bool": True,
    "string": "é",
    "vector": (0.1, -2.0, 3.0),
    "quaternion": (1.0, 0.0, 0.0, 0.0),
    "floats": [0.5, math.inf],
    "bytes": b"\xff\xd8",
}


@pytest.mark.parametrize("topic", TOPICS.values(), ids=lambda topic: topic.name)
def test_a_message_has_the_bytes_that_rosbags_writes(topic):
    row = (2_500_000_001, *[EXAMPLES[field.kind] for field in topic.fields])
    data = encode(topic, row)
    message = STORE.deserialize_cdr(data, topic.ros_type)
    assert bytes(STORE.serialize_cdr(message, topic.ros_type)) == data
    assert decode(topic, data) == row


@pytest.mark.parametrize("ros_type", sorted({topic.ros_type for topic in TOPICS.values()}))
def test_a_definition_stands_on_its_own(ros_type):
    text = definition(ros_type)
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(text, ros_type))
    assert store.hash_rihs01(ros_type) == type_hash(ros_type)
    assert is_known(ros_type, text)
    own, _, _ = text.partition("=" * 80)
    assert "cloudrc" not in ros_type or all("#" in line for line in own.splitlines())


@pytest.mark.parametrize(
    ("old", "new", "known"),
    [
        ("# [s]", "# seconds:", True),
        ("float64 delay", "float32 delay", False),
        ("int64 epoch", "int64 (", False),
    ],
)
def test_another_layout_is_noticed(old, new, known):
    text = definition("cloudrc_msgs/msg/Arrival")
    assert old in text
    assert is_known("cloudrc_msgs/msg/Arrival", text.replace(old, new)) is known
