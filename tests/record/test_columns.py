"""Columns hold the records' values, from memory and from a file."""

from operator import attrgetter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cloudrc.record.columns import Recording, RecordStore
from cloudrc.record.topics import TOPICS
from tests.record.conftest import MS, any_record, assert_equal, cloud_records, world_records, write


def test_a_topic_without_rows_is_an_empty_table_of_its_types():
    shapes = {"vector": (0, 3), "quaternion": (0, 4)}
    types = {"bool": np.bool_, "int": np.int64, "string": np.object_}
    recording = Recording.from_records([])
    for name, topic in TOPICS.items():
        table = recording[name]
        assert table.names == ("stamp_ns", *(field.name for field in topic.fields))
        assert len(table) == len(table["stamp_ns"]) == 0
        for field in topic.fields:
            assert table[field.name].shape == shapes.get(field.kind, (0,))
            assert table[field.name].dtype == types.get(field.kind, np.float64), field


def test_the_error_for_an_unknown_name_lists_known_names():
    recording = Recording.from_records([])
    with pytest.raises(KeyError, match="no topic '/odometri'; there are: /odometry, /telemetry"):
        recording["/odometri"]
    with pytest.raises(KeyError, match="no column 'x' in /guard; it has: stamp_ns, state, cause"):
        recording["/guard"]["x"]


@given(st.lists(any_record(), max_size=12))
@settings(max_examples=30, deadline=None)
def test_a_file_gives_what_memory_gives(tmp_path_factory, records):
    records.sort(key=attrgetter("stamp_ns"))
    path = write(tmp_path_factory.getbasetemp() / "any.mcap", records)
    recording = Recording.read(path)
    assert recording.complete
    assert_equal(recording, Recording.from_records(records))


def test_batches_do_not_matter_and_worlds_row_comes_first(monkeypatch):
    monkeypatch.setattr("cloudrc.record.hash.BLOCK", 7)
    ends = world_records(20), cloud_records(20)
    store = RecordStore()
    for end_ns in range(50 * MS, 400 * MS, 50 * MS):
        batch = [[r for r in end if end_ns - 50 * MS <= r.stamp_ns < end_ns] for end in ends]
        store.add(*batch)
    monkeypatch.undo()
    assert_equal(store.recording(), Recording.from_records(*ends))
    assert store.recording()["/session"]["end"].tolist() == ["world", "cloud"]
