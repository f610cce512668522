"""The topics contain all values of the records, with their names and units."""

from __future__ import annotations

import re
from operator import attrgetter
from typing import Any, get_type_hints

import pytest
from hypothesis import given, settings

from cloudrc import records as rec
from cloudrc.messages import GuardState
from cloudrc.record.topics import TOPICS, Field, Topic, rows
from tests.record.conftest import CLASSES, any_record

COLUMNS = [(topic, field) for topic in TOPICS.values() for field in topic.fields]


def leaves(cls: type[Any], prefix: str = "") -> set[str]:
    found = set()
    for name, kind in get_type_hints(cls).items():
        inner = leaves(kind, f"{prefix}{name}.") if hasattr(kind, "_fields") else {prefix + name}
        found |= inner
    return found


@given(any_record())
@settings(max_examples=60, deadline=None)
def test_rows_hold_the_record_s_own_values(record: Any) -> None:
    found = rows(record)
    assert found
    for name, stamp_ns, values in found:
        topic = TOPICS[name]
        assert type(record) is topic.source
        assert stamp_ns == attrgetter(topic.stamp_path)(record)
        assert len(values) == len(topic.fields)
        for field, value in zip(topic.fields, values, strict=True):
            assert value is attrgetter(field.path or field.name)(record)


def test_a_datagram_s_direction_chooses_the_topic() -> None:
    (up,) = rows(rec.Arrival(5, True, 1, 2, 0.04, True))
    (down,) = rows(rec.Arrival(6, False, 1, 3, 0.05, False))
    assert up == ("/uplink_delay", 5, (1, 2, 0.04, True))
    assert down == ("/downlink_delay", 6, (1, 3, 0.05, False))


def test_a_guard_change_is_one_row() -> None:
    assert rows(rec.GuardChange(7, GuardState.HOLD, "silence")) == [
        ("/guard", 7, (GuardState.HOLD, "silence"))
    ]


@pytest.mark.parametrize("cls", CLASSES, ids=lambda cls: cls.__name__)
def test_nothing_that_a_record_holds_is_left_out(cls: type[Any]) -> None:
    topics = [topic for topic in TOPICS.values() if topic.source is cls]
    recorded = {field.path or field.name for topic in topics for field in topic.fields}
    recorded |= {topic.stamp_path for topic in topics}
    chosen_by = {"uplink"} if cls is rec.Arrival else set()
    assert leaves(cls) - recorded - chosen_by <= {"stamp_ns"}


@pytest.mark.parametrize("cls", CLASSES, ids=lambda cls: cls.__name__)
def test_the_record_s_docstring_names_its_topics(cls: type[Any]) -> None:
    named = set(re.findall(r"(?<!\w)/[a-z_]+", (cls.__doc__ or "").partition("Attributes:")[0]))
    topics = {name for name, topic in TOPICS.items() if topic.source is cls}
    # The docstring of GroundTruth has its force among the attributes.
    assert named == topics - {"/contact_force"}


@pytest.mark.parametrize(("topic", "field"), COLUMNS, ids=lambda part: part.name)
def test_every_number_has_a_unit_and_every_column_a_meaning(topic: Topic, field: Field) -> None:
    assert field.text
    assert (field.path or field.name) in leaves(topic.source)
    if field.kind in ("float", "vector", "quaternion") or field.name.endswith("_ns"):
        assert field.unit
