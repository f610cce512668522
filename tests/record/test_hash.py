"""The hash depends on the records' values and on nothing else."""

import hashlib
import struct

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


def test_the_bytes_are_those_that_the_module_promises():
    applied = rec.CommandApplied(1, 2, 3, -4, (0.5, 1.0, 2.0))
    data = b"\x0eCommandApplied" + struct.pack("<5q3d", 1, 2, 3, -4, -1, 0.5, 1.0, 2.0)
    change = rec.GuardChange(5, GuardState.HOLD, "né")
    data += b"\x0bGuardChange" + struct.pack("<2qI", 5, 2, 3) + b"n\xc3\xa9"
    arrival = rec.Arrival(6, True, 7, 8, 0.25, False)
    data += b"\x07Arrival" + struct.pack("<q?2qd?", 6, True, 7, 8, 0.25, False)
    vectors = [tuple(float(10 * n + axis) for axis in range(3 + (n == 1))) for n in range(5)]
    truth = rec.GroundTruth(9, Odometry(10, *vectors[:4]), 0.5, 0.75, 0.125, vectors[4])
    data += b"\x0bGroundTruth" + struct.pack("<2q3d", 9, 10, 0.5, 0.75, 0.125)
    data += struct.pack("<16d", *sum(vectors, ()))
    assert digest(applied, change, arrival, truth) == hashlib.sha256(data).hexdigest()


@given(st.lists(any_record(), max_size=6), st.integers(0, 6))
@settings(max_examples=30, deadline=None)
def test_batches_do_not_matter(records, cut):
    found = RecordHash()
    found.update(records[:cut])
    found.update(iter(records[cut:]))
    assert found.hexdigest() == digest(*records)
