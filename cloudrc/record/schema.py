"""What a topic is: a table of the recording, its columns and their units.

The topics themselves are listed in `cloudrc/record/topics.py`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

from cloudrc.records import Record

Kind: TypeAlias = Literal["int", "float", "bool", "string", "vector", "quaternion"]
Values: TypeAlias = tuple[Any, ...]
Row: TypeAlias = tuple[str, int, Values]
"""Topic, stamp [ns] on the clock of the end that recorded it, values in the order of the fields."""


@dataclass(frozen=True, slots=True)
class Field:
    """A column of a topic.

    Attributes:
        name: Of the column and of the ROS field.
        kind: What one value is; vectors have shape (3,), quaternions shape (4,).
        unit: In words, "" if it has none.
        text: What it means.
        path: Where the record holds it, dotted; "" if that is its name.
    """

    name: str
    kind: Kind
    unit: str
    text: str
    path: str = ""


@dataclass(frozen=True, slots=True)
class Topic:
    """A table of the recording.

    Attributes:
        name: As in MCAP, with its slash.
        ros_type: Message type; those in `cloudrc_msgs` are defined by `fields`.
        source: Record class that it is made from.
        end: Who records it: "world", "cloud" or "either".
        text: What one row is.
        fields: The columns after `stamp_ns`.
        stamp_path: Where the record holds the row's stamp, dotted.
    """

    name: str
    ros_type: str
    source: type[Record]
    end: Literal["world", "cloud", "either"]
    text: str
    fields: tuple[Field, ...]
    stamp_path: str = "stamp_ns"
