"""The ROS 2 message types of the recording: the table of topics goes in, definitions come out.

The types in `cloudrc_msgs` are written from `cloudrc/record/topics.py`, with a comment and a unit
for each field; the others are ROS's own. rosbags parses, encodes and hashes them all.
"""

from __future__ import annotations

from functools import lru_cache

from cloudrc.record.packages import missing
from cloudrc.record.schema import Kind
from cloudrc.record.topics import TOPICS

try:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore
except ImportError as error:
    raise missing(error) from error

_OURS = "cloudrc_msgs/"
_ROS_NAMES: dict[Kind, str] = {
    "int": "int64",
    "float": "float64",
    "bool": "bool",
    "string": "string",
    "vector": "geometry_msgs/Vector3",
    "quaternion": "geometry_msgs/Quaternion",
}


def _own_definition(ros_type: str) -> str:
    topics = [topic for topic in TOPICS.values() if topic.ros_type == ros_type]
    lines = [f"# {topic.name}: {topic.text}" for topic in topics]
    lines.append("std_msgs/Header header  # stamp: instant of the row")
    for field in topics[0].fields:
        unit = f"[{field.unit}] " if field.unit else ""
        lines.append(f"{_ROS_NAMES[field.kind]} {field.name}  # {unit}{field.text}")
    return "\n".join(lines) + "\n"


_OWN = {t.ros_type: _own_definition(t.ros_type) for t in TOPICS.values() if _OURS in t.ros_type}

TEXT_MAX = 1 << 16
"""Longest definition that is compared [characters]; ours and ROS's own have some thousand."""
STORE = get_typestore(Stores.ROS2_JAZZY)
"""Rosbags' types, ours among them."""
for _name, _text in _OWN.items():
    STORE.register(get_types_from_msg(_text, _name))


def _whole_definition(ros_type: str) -> str:
    text, _ = STORE.generate_msgdef(ros_type, ros_version=2)
    own, mark, needed = text.partition("=" * 80)
    return _OWN.get(ros_type, own) + mark + needed


# All is generated on import: rosbags takes some milliseconds for each type, and in flight the
# thread that writes would keep the loop waiting for so long at the first message of each.
_NAMES = {topic.ros_type for topic in TOPICS.values()}
_DEFINITIONS = {name: _whole_definition(name) for name in _NAMES}
_HASHES = {name: STORE.hash_rihs01(name) for name in _NAMES}
for _name in _NAMES:
    STORE.get_msgdef(_name)


def definition(ros_type: str) -> str:
    """Write a message type out for a schema in the encoding `ros2msg`.

    Args:
        ros_type: As in the table of topics.

    Returns:
        Its definition, our own with a comment and a unit for each field, and those it needs.
    """
    return _DEFINITIONS[ros_type]


def type_hash(ros_type: str) -> str:
    """Say the RIHS01 hash by which ROS 2 tells a message type.

    Args:
        ros_type: As in the table of topics.
    """
    return _HASHES[ros_type]


@lru_cache(maxsize=256)
def is_known(ros_type: str, text: str) -> bool:
    """Tell whether a definition found in a file has the layout that `decode` expects.

    Args:
        ros_type: Name of the message type.
        text: Its definition in the encoding `ros2msg`; comments do not matter.
    """
    if text == definition(ros_type):
        return True
    if len(text) > TEXT_MAX:  # its parser takes its time
        return False
    try:
        found = get_types_from_msg(text, ros_type)
    except Exception:  # rosbags' parser of a foreign text: whatever it raises, it is not ours
        return False
    known = STORE.fielddefs
    return all(name in known and known[name][1] == found[name][1] for name in found)
