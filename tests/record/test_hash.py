"""The hash depends on the records' values and on nothing else."""

import hashlib
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cloudrc import records as rec
from cloudrc.messages import GuardState
from cloudrc.record.hash import RecordHash
from tests.record.conftest import CLASSES, any_record, cloud_records, world_records

LINK = rec.LinkChanged(1, True, "relay", "by hand", 0.1, 2.0, 0.04, 0.01, 0.1, 1e6, "{}")
LATE = rec.Lateness(1, "world", 0.1, 0.2, 3)
CHECK = rec.LinkChecked(1, True, "mean", 0.04, 0.05, 0.03, 0.06, "ok", 3000)


def digest(*records):
    found = RecordHash()
    found.update(records)
    return found.hexdigest()


def test_the_bytes_are_those_that_the_module_promises():
    applied = rec.CommandApplied(1, 2, 3, -4, (0.5, 1.0, 2.0))
    data = b"\x0eCommandApplied" + struct.pack("<4q3d", 1, 2, 3, -4, 0.5, 1.0, 2.0)
    change = rec.GuardChange(5, GuardState.HOLD, "né")
    data += b"\x0bGuardChange" + struct.pack("<2qI", 5, 2, 3) + b"n\xc3\xa9"
    assert digest(applied, change) == hashlib.sha256(data).hexdigest()


@given(st.lists(any_record(), max_size=6), st.integers(0, 6))
@settings(max_examples=30, deadline=None)
def test_batches_do_not_matter(records, cut):
    found = RecordHash()
    found.update(records[:cut])
    found.update(iter(records[cut:]))
    assert found.hexdigest() == digest(*records)


def changed(value):
    """Return a different value of the same type."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, GuardState):
        return GuardState((value + 1) % len(GuardState))
    if isinstance(value, tuple):
        return (*value[:-1], changed(value[-1]))
    if isinstance(value, str):
        return value + "x"
    return 0.1 if value != value else value + 1


def variants(instance):
    """Return the record with each of its values changed in turn."""
    found = []
    for name in instance._fields:
        value = getattr(instance, name)
        inner = variants(value) if hasattr(value, "_fields") else [changed(value)]
        found += [instance._replace(**{name: each}) for each in inner]
    return found


@pytest.mark.parametrize("cls", CLASSES, ids=lambda cls: cls.__name__)
def test_every_value_counts(cls):
    every = [*world_records(9), *cloud_records(9), LATE, LINK, CHECK]
    record = next(each for each in every if type(each) is cls)
    digests = [digest(record), *map(digest, variants(record))]
    assert len(set(digests)) == len(digests) > len(record._fields)
