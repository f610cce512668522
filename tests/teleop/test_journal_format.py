"""The journal's bytes: exact, and read in peace whatever has become of them."""

import zlib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cloudrc.teleop.journal import HEAD, LENGTH_MAX, MAGIC, MARK, parse, to_record
from tests.teleop.conftest import SOME, records, whole

values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=8,
)
entries = st.lists(st.dictionaries(st.text(), values, max_size=4), max_size=6)


def test_the_layout_is_frozen():
    """Another version has to read what this one wrote."""
    assert whole([{"a": 1}, {"é": None}]).hex() == (
        "9343524a0d0a1a0a"
        "c54a4501" "07000000" "0100000000000000" "1deabae2" "7b2261223a317d"
        "c54a4501" "0f000000" "0200000000000000" "14623ed1" "7b225c7530306539223a6e756c6c7d"
    )  # fmt: skip


@settings(max_examples=100, deadline=None)
@given(entries)
def test_entries_are_read_back_exactly(some):
    data = whole(some)
    assert parse(data) == (some, len(some), len(data), 0, 0, True)


@settings(max_examples=200, deadline=None)
@given(entries, st.data())
def test_cut_at_any_byte_all_whole_entries_are_there(some, data):
    full = whole(some)
    cut = data.draw(st.integers(0, len(full)))
    found = parse(full[:cut])
    count = len(found.entries)
    assert found.entries == some[:count]
    assert (found.known, found.lost) == (True, 0)
    assert found.end == (len(whole(some[:count])) if cut >= len(MAGIC) else 0)
    assert found.end + found.torn == cut
    assert count == len(some) or cut < len(whole(some[: count + 1]))


def test_a_flipped_byte_costs_at_most_one_entry_and_is_noticed():
    full = whole(SOME)
    for at in range(len(full)):
        for bit in (0x01, 0x80):
            data = bytearray(full)
            data[at] ^= bit
            found = parse(bytes(data))
            kept = [entry for entry in SOME if entry in found.entries]
            assert found.entries == kept, at
            assert len(kept) >= len(SOME) - (at >= len(MAGIC))
            assert found.torn or found.lost or not found.known, at


def test_a_hole_between_two_records_is_no_loss():
    """A refused entry that could not be cut off again leaves one."""
    one, other = records(SOME[:2])
    for rubbish in (one[: HEAD + 3], b"\0" * 9, MARK, b"{}"):
        found = parse(MAGIC + one + rubbish + other)
        assert (found.entries, found.torn, found.lost) == (SOME[:2], 0, 0)


def test_a_record_that_is_not_newer_does_not_count():
    one, other = records(SOME[:2])
    found = parse(MAGIC + one + other + one)
    assert (found.entries, found.number, found.torn) == (SOME[:2], 2, len(one))


def forged(payload, length=None):
    """A record of any payload with a CRC that fits."""
    counted = (len(payload) if length is None else length).to_bytes(4, "little")
    counted += (1).to_bytes(8, "little")
    crc = zlib.crc32(payload, zlib.crc32(counted)).to_bytes(4, "little")
    return MARK + counted + crc + payload


@pytest.mark.parametrize(
    "record",
    [
        forged(b"[1]"),
        forged(b"no JSON"),
        forged(b"[" * 100_000),
        forged(b"\xff"),
        forged(b"{}", length=3),
        forged(b'{"a":"' + b"x" * LENGTH_MAX + b'"}'),
    ],
)
def test_a_record_that_is_no_entry_is_left_out(record):
    assert parse(MAGIC + record) == ([], 0, len(MAGIC), len(record), 0, True)


@pytest.mark.parametrize("long", [0, 100_000])
def test_forged_records_in_each_other_take_no_longer_than_others(monkeypatch, long):
    """Each says that it goes to the end, or as far as a record may."""
    summed, count = [], 5_000
    heads = [
        MARK + (long or (count - n) * HEAD).to_bytes(4, "little") + n.to_bytes(8, "little")
        for n in range(1, count + 1)
    ]
    data = MAGIC + b"".join(head.ljust(HEAD, b"?") for head in heads) + b" " * long
    with monkeypatch.context() as patch:
        crc32 = zlib.crc32
        patch.setattr(
            zlib, "crc32", lambda part, *more: summed.append(len(part)) or crc32(part, *more)
        )
        assert parse(data) == ([], 0, len(MAGIC), len(data) - len(MAGIC), 0, True)
    assert sum(summed) <= 2 * len(data)


def test_marks_in_a_records_head_do_not_hide_it():
    number = int.from_bytes(MARK, "little")
    record = to_record(number, SOME[0])
    assert record.count(MARK) == 2
    assert (parse(MAGIC + record).entries, parse(MAGIC + record).number) == (SOME[:1], number)


def test_the_longest_record_counts():
    record = forged(b'{"a":"' + b"x" * (LENGTH_MAX - 8) + b'"}')
    assert len(parse(MAGIC + record).entries) == 1


@settings(max_examples=300, deadline=None)
@given(st.binary(max_size=200))
def test_any_bytes_are_read_in_peace(data):
    found = parse(MAGIC + data)
    assert found.end + found.torn == len(MAGIC) + len(data)


def test_records_without_a_head_are_found():
    found = parse(b"".join(records(SOME)))
    assert (found.entries, found.known, found.torn) == (SOME, False, 0)


def test_a_record_that_comes_twice_counts_once():
    one, _ = records(SOME[:2])
    found = parse(MAGIC + one + one)
    assert (found.entries, found.torn) == (SOME[:1], len(one))
