# SPDX-License-Identifier: Apache-2.0

"""Columns and hash depend on the records alone, from memory and from a file."""

import hashlib
import struct
from operator import attrgetter

from hypothesis import given, settings
from hypothesis import strategies as st

from cloudrc.results.record.columns import Recording, RecordStore
from cloudrc.results.record.topics import ADDED, TOPICS, UNHASHED
from cloudrc.wire import records as rec
from tests.results.record.conftest import (
    MS,
    any_record,
    assert_equal,
    cloud_records,
    world_records,
    write,
)


@given(st.lists(any_record(), max_size=12))
@settings(max_examples=12, deadline=None)
def test_a_file_gives_what_memory_gives(tmp_path_factory, records):
    records.sort(key=attrgetter("stamp_ns"))
    path = write(tmp_path_factory.getbasetemp() / "any.mcap", records)
    recording = Recording.read(path)
    assert recording.note == ""
    memory = Recording.from_records(records)
    assert_equal(recording, memory)
    assert recording.sha256 == memory.sha256
    changed = [record._replace(stamp_ns=record.stamp_ns + 1) for record in records]
    unhashed = tuple(TOPICS[name].source for name in UNHASHED)
    is_hashed = any(not isinstance(each, unhashed) for each in records)
    assert (Recording.from_records(changed).sha256 != memory.sha256) == is_hashed


def test_the_hashed_bytes_are_those_in_the_docstring():
    """The rows of /session are in the order of their stamps, strings are in UTF-8."""
    opened = rec.SessionOpened(7, "world", 1, "né"), rec.SessionOpened(5, "cloud", 2, "\ud800")
    command = rec.CommandApplied(1, 2, 3, -4, (0.5, 1.0, 2.0))
    bytes_of = {
        "/session": struct.pack("<2q", 5, 7)
        + b"[b'cloud', b'world']"
        + struct.pack("<2q", 2, 1)
        + rb"[b'?', b'n\xc3\xa9']",
        "/command_applied": struct.pack("<4q3dq", 1, 2, 3, -4, 0.5, 1.0, 2.0, -1),
    }
    hashed = b""
    for name in [name for name in TOPICS if name not in ADDED + UNHASHED]:
        rows = {"/session": 2, "/command_applied": 1}.get(name, 0)
        texts = b"[]" * sum(field.kind == "string" for field in TOPICS[name].fields)
        hashed += f"{name} {rows}\n".encode() + bytes_of.get(name, texts)
    found = Recording.from_records([*opened, command, rec.EnergyUsed(1, 2.0)]).sha256
    assert found == hashlib.sha256(hashed).hexdigest()


def test_batches_do_not_matter_and_worlds_row_comes_first(monkeypatch):
    monkeypatch.setattr("cloudrc.results.record.columns.BLOCK", 7)
    ends = world_records(20), cloud_records(20)
    store = RecordStore()
    for end_ns in range(50 * MS, 400 * MS, 50 * MS):
        batch = [[r for r in end if end_ns - 50 * MS <= r.stamp_ns < end_ns] for end in ends]
        store.add(*batch)
    monkeypatch.undo()
    recording = Recording(records=store)
    assert_equal(recording, whole := Recording.from_records(*ends))
    assert recording.sha256 == whole.sha256
    assert recording["/session"]["end"].tolist() == ["world", "cloud"]
