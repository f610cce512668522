"""The hash depends on the records' values and on nothing else."""

import hashlib
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cloudrc import records as rec
from cloudrc.messages import GuardState, Odometry
from cloudrc.record.hash import RecordHash
from tests.record.conftest import any_record


def digest(*records):
    found = RecordHash()
    found.update(records)
    return found.hexdigest()


def sha256(*parts):
    return hashlib.sha256(b"".join(parts)).digest()


def test_the_hashed_bytes_are_those_in_the_docstring(monkeypatch):
    """The hash covers blocks of two records, column by column, and types by name."""
    monkeypatch.setattr("cloudrc.record.hash.BLOCK", 2)
    applied = [rec.CommandApplied(n, 2, 3, -4, (0.5, 1.0, 2.0 + n)) for n in range(3)]
    pair = struct.pack("<8q6d2q", 0, 1, 2, 2, 3, 3, -4, -4, 0.5, 1, 2, 0.5, 1, 3, -1, -1)
    single = struct.pack("<4q3dq", 2, 2, 3, -4, 0.5, 1.0, 4.0, -1)
    arrival = rec.Arrival(6, True, 7, 8, 0.25, False)
    arrived = struct.pack("<q?2qd?", 6, True, 7, 8, 0.25, False)
    vectors = [tuple(float(10 * n + axis) for axis in range(3 + (n == 1))) for n in range(5)]
    truth = rec.GroundTruth(9, Odometry(10, *vectors[:4]), 0.5, 0.75, 0.125, vectors[4])
    true = struct.pack("<2q13d", 9, 10, *sum(vectors[:4], ()))
    true += struct.pack("<3d3d", 0.5, 0.75, 0.125, *vectors[4])
    change = rec.GuardChange(5, GuardState.HOLD, "né")
    changed = struct.pack("<2qI", 5, 2, 3) + b"n\xc3\xa9"
    total = b"Arrival 1 %s\n" % sha256(arrived)
    total += b"CommandApplied 3 %s\n" % sha256(pair, single)
    total += b"GroundTruth 1 %s\n" % sha256(true) + b"GuardChange 1 %s\n" % sha256(changed)
    assert digest(truth, *applied, change, arrival) == sha256(total).hex()


@given(st.lists(any_record(), max_size=12), st.integers(0, 12), st.integers(1, 4))
@settings(max_examples=30, deadline=None)
def test_batches_do_not_matter(records, cut, block):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("cloudrc.record.hash.BLOCK", block)
        found = RecordHash()
        found.update(records[:cut])
        found.update(iter(records[cut:]))
        assert found.hexdigest() == digest(*records)
