# SPDX-License-Identifier: Apache-2.0

"""The topics contain all values of the records, with their names and units."""

import re
from typing import get_type_hints

import pytest

from cloudrc.results.record.topics import TOPICS
from cloudrc.wire import records as rec
from tests.results.record.conftest import CLASSES


def leaves(cls, prefix=""):
    found = set()
    for name, kind in get_type_hints(cls).items():
        found |= leaves(kind, f"{prefix}{name}.") if hasattr(kind, "_fields") else {prefix + name}
    return found


@pytest.mark.parametrize("cls", CLASSES, ids=lambda cls: cls.__name__)
def test_every_value_is_recorded_and_documented(cls):
    topics = {name: topic for name, topic in TOPICS.items() if topic.source is cls}
    recorded = {field.path for topic in topics.values() for field in topic.fields}
    # The end of an arrival chooses its topic, and its echo is in the telemetry; sensors are rows of
    # another topic.
    arrival = {"uplink", "echo_stamp_ns", "echo_hold_ns", "is_sample"}
    others = {rec.Arrival: arrival, rec.TelemetrySent: {"telemetry.sensors"}}
    others[rec.ScanTaken] = {"epoch", "counter"}  # ROS's message has no place for them
    others = others.get(cls, {"sensor"} & leaves(cls))
    stamps = {f"{topic.parts[0]}stamp_ns" for topic in topics.values()}
    assert leaves(cls) - recorded - others - stamps <= {"stamp_ns"}
    assert recorded <= leaves(cls)
    named = set(re.findall(r"(?<!\w)/[a-z_]+", (cls.__doc__ or "").partition("Attributes:")[0]))
    assert named == topics.keys()
    for field in (field for topic in topics.values() for field in topic.fields):
        assert field.text
        numbers = field.kind in ("float", "vector", "quaternion") or field.name.endswith("_ns")
        assert field.unit or not numbers
