"""The journal: exact, whole after a crash at any byte, and one process at a time."""

import os

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cloudrc.cloud.teleop.journal import Journal, JournalLockedError, parse, to_line

values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=8,
)
entries = st.lists(st.dictionaries(st.text(), values, max_size=4), max_size=6)

SOME = [{"kind": "event", "n": n, "text": f"é\n{n}", "limit": float("inf")} for n in range(4)]


@settings(max_examples=100, deadline=None)
@given(entries)
def test_entries_are_read_back_exactly(some):
    data = b"".join(map(to_line, some))
    assert parse(data) == (some, len(data), 0)


@settings(max_examples=200, deadline=None)
@given(entries, st.data())
def test_cut_at_any_byte_all_whole_entries_are_there(some, data):
    lines = [to_line(entry) for entry in some]
    whole = b"".join(lines)
    cut = data.draw(st.integers(0, len(whole)))
    found, good, damaged = parse(whole[:cut])
    assert found == some[: len(found)]
    assert good == sum(map(len, lines[: len(found)])) <= cut
    assert len(found) == len(some) or cut < good + len(lines[len(found)])
    assert damaged == 0


def write(path, some):
    with Journal(path) as journal:
        for entry in some:
            journal.append(entry)


def test_it_is_there_when_it_is_opened_again(tmp_path):
    path = tmp_path / "new" / "journal.jsonl"
    write(path, SOME[:2])
    write(path, SOME[2:])
    with Journal(path) as journal:
        assert (journal.entries, journal.trouble) == (SOME, "")


def test_a_torn_end_is_cut_and_reported(tmp_path):
    path = tmp_path / "journal.jsonl"
    write(path, SOME)
    torn = len(to_line(SOME[-1])) - 3
    path.write_bytes(path.read_bytes()[:-3])
    with Journal(path) as journal:
        assert journal.entries == SOME[:3]
        assert f"{torn} bytes of a torn entry were cut off" in journal.trouble
        journal.append(SOME[3])
    with Journal(path) as journal:
        assert (journal.entries, journal.trouble) == (SOME, "")


def test_damage_in_the_middle_is_left_out_and_a_copy_kept(tmp_path):
    path = tmp_path / "journal.jsonl"
    write(path, SOME)
    data = bytearray(path.read_bytes())
    data[len(to_line(SOME[0])) + 20] ^= 1
    path.write_bytes(data)
    with Journal(path) as journal:
        assert journal.entries == [SOME[0], *SOME[2:]]
        assert "1 damaged entries" in journal.trouble
    assert (tmp_path / "journal.jsonl.damaged").read_bytes() == data


def test_a_second_one_is_kept_out_until_the_first_ends(tmp_path):
    path = tmp_path / "journal.jsonl"
    with Journal(path) as first:
        first.append(SOME[0])
        with pytest.raises(JournalLockedError, match="another teleop"):
            Journal(path)
        first.rewrite([SOME[1]])  # a new file of the same name is locked likewise
        with pytest.raises(JournalLockedError):
            Journal(path)
    with Journal(path) as second:
        assert second.entries == [SOME[1]]


def test_every_entry_is_synced_before_it_counts(tmp_path, monkeypatch):
    with Journal(tmp_path / "journal.jsonl") as journal:
        synced, fsync = [], os.fsync
        monkeypatch.setattr(os, "fsync", lambda file: (synced.append(file), fsync(file)))
        for count, entry in enumerate(SOME, 1):
            journal.append(entry)
            assert len(synced) == count


def test_a_full_disk_leaves_the_journal_as_it_was(tmp_path, monkeypatch):
    path, real = tmp_path / "journal.jsonl", os.write

    def write_half(file, data):
        if len(data) < 20:
            raise OSError(28, "No space left on device")
        return real(file, data[:20])

    with Journal(path) as journal:
        journal.append(SOME[0])
        monkeypatch.setattr(os, "write", write_half)
        with pytest.raises(OSError, match="No space"):
            journal.append(SOME[1])
        monkeypatch.undo()
        journal.append(SOME[2])
    with Journal(path) as journal:
        assert (journal.entries, journal.trouble) == ([SOME[0], SOME[2]], "")
