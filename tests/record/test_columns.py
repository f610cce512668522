"""Columns hold the records' values, from memory and from a file."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cloudrc import records as rec
from cloudrc.record.columns import Recording
from cloudrc.record.topics import TOPICS
from tests.record.conftest import any_record, assert_equal, cloud_records, world_records, write


def test_kinds_have_their_types():
    recording = Recording.from_records(world_records(3), cloud_records(3))
    table = recording["/command_applied"]
    assert table.names == ("stamp_ns", "epoch", "counter", "basis_stamp_ns", "velocity")
    assert recording["/guard"]["state"].dtype == np.int64
    assert recording["/guard"]["cause"].tolist() == ["mission started"]
    assert recording["/uplink_delay"]["used"].dtype == np.bool_
    assert recording["/uplink_delay"]["delay"].dtype == np.float64
    assert recording["/estimated_odometry"]["orientation_wxyz"].shape == (3, 4)


def test_a_topic_without_rows_is_an_empty_table():
    shapes = {"vector": (0, 3), "quaternion": (0, 4)}
    recording = Recording.from_records([])
    for name, topic in TOPICS.items():
        table = recording[name]
        assert len(table) == len(table["stamp_ns"]) == 0
        for field in topic.fields:
            assert table[field.name].shape == shapes.get(field.kind, (0,))


def test_what_does_not_exist_is_answered_with_what_does():
    recording = Recording.from_records([])
    with pytest.raises(KeyError, match="no topic '/odometri'; there are: /odometry, /telemetry"):
        recording["/odometri"]
    with pytest.raises(KeyError, match="no column 'x' in /guard; it has: stamp_ns, state, cause"):
        recording["/guard"]["x"]


def test_rows_of_both_ends_are_in_order_of_time():
    world = [rec.Counted(t, "world", "sent", t) for t in (0, 10, 20, 20)]
    cloud = [rec.Counted(t, "cloud", "sent", t) for t in (5, 20, 30)]
    expected = ["world", "cloud", "world", "world", "world", "cloud", "cloud"]
    assert Recording.from_records(world, cloud)["/count"]["end"].tolist() == expected


@given(st.lists(any_record(), max_size=12))
@settings(max_examples=30, deadline=None)
def test_a_file_gives_what_memory_gives(tmp_path_factory, records):
    path = write(tmp_path_factory.getbasetemp() / "any.mcap", records)
    recording = Recording.read(path)
    assert recording.complete
    assert_equal(recording, Recording.from_records(records))
