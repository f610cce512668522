"""The journal on a real disk: exact, whole after a crash at any byte, one process at a time."""

import os
import re
import tracemalloc
from pathlib import Path

import pytest

from cloudrc.errors import BadInputError
from cloudrc.teleop import journal as journal_disk
from cloudrc.teleop.journal import HEAD, MAGIC, Disk, Journal, JournalLockedError
from tests.teleop.conftest import SOME, records, whole


def write(path, some):
    with Journal(path) as journal:
        for entry in some:
            journal.append(entry)


def test_it_is_there_when_it_is_opened_again(tmp_path):
    path = tmp_path / "new" / "journal"
    write(path, SOME[:2])
    write(path, SOME[2:])
    with Journal(path) as journal:
        assert (journal.entries, journal.trouble, journal.repaired) == (SOME, "", False)
    assert path.read_bytes() == whole(SOME)
    assert path.stat().st_mode & 0o777 == 0o600


def test_what_is_written_is_on_the_disk_when_it_returns(tmp_path, monkeypatch):
    path, synced = tmp_path / "journal", []

    def fsync(file):
        synced.append((os.readlink(f"/proc/self/fd/{file}"), os.fstat(file).st_size))
        true_fsync(file)

    with Journal(path) as journal:
        true_fsync = os.fsync
        monkeypatch.setattr(os, "fsync", fsync)
        journal.append(SOME[0])
        assert synced == [(str(path), len(whole(SOME[:1])))]
        synced.clear()
        journal.rewrite(SOME)
    new, folder = synced
    assert new == (f"{path}.new", len(whole(SOME)))
    assert folder[0] == str(tmp_path)


def test_a_torn_end_is_cut_and_reported(tmp_path):
    path = tmp_path / "journal"
    write(path, SOME)
    torn = len(records(SOME)[-1]) - 3
    path.write_bytes(path.read_bytes()[:-3])
    with Journal(path) as journal:
        assert (journal.entries, journal.repaired) == (SOME[:3], True)
        said = f"journal repaired: {path}: {torn} bytes of a torn entry were cut off"
        assert journal.trouble == said
        assert path.read_bytes() == whole(SOME[:3])
        journal.append(SOME[3])
    with Journal(path) as journal:
        assert (journal.entries, journal.trouble) == (SOME, "")


def test_damage_in_the_middle_is_left_out_and_a_copy_kept(tmp_path):
    path = tmp_path / "journal"
    write(path, SOME)
    data = bytearray(path.read_bytes())
    data[len(whole(SOME[:1])) + HEAD + 2] ^= 1
    path.write_bytes(data)
    with Journal(path) as journal:
        assert journal.entries == [SOME[0], *SOME[2:]]
        copy = tmp_path / "journal.damaged"
        assert journal.trouble == (
            f"journal repaired: {path}: 1 damaged entries were left out; see {copy}"
        )
        assert journal.repaired
        journal.append(SOME[1])
    assert copy.read_bytes() == data
    with Journal(path) as journal:
        assert (journal.entries, journal.trouble) == ([SOME[0], *SOME[2:], SOME[1]], "")
    assert not (tmp_path / "journal.new").exists()


def test_a_damaged_head_is_mended(tmp_path):
    path = tmp_path / "journal"
    path.write_bytes(b"?" + whole(SOME)[1:])
    with Journal(path) as journal:
        assert journal.entries == SOME
        assert "its head was damaged; see" in journal.trouble
    assert path.read_bytes() == whole(SOME)


@pytest.mark.parametrize("cut", range(len(MAGIC)))
def test_a_crash_at_its_very_beginning_leaves_an_empty_one(tmp_path, cut):
    path = tmp_path / "journal"
    path.write_bytes(MAGIC[:cut])
    with Journal(path) as journal:
        assert (journal.entries, journal.repaired) == ([], cut > 0)
        journal.append(SOME[0])
    assert path.read_bytes() == whole(SOME[:1])


def test_another_file_is_not_touched(tmp_path):
    path = tmp_path / "precious"
    path.write_bytes(b"my thesis")
    for _ in range(2):  # the lock is let go
        with pytest.raises(BadInputError, match=r"--journal .*precious: is no journal; name an"):
            Journal(path)
    assert path.read_bytes() == b"my thesis"


def refused(path, said):
    """It is said what to do, nothing is waited for, and no lock stays."""
    for _ in range(2):
        with pytest.raises(BadInputError, match=f"^--journal {re.escape(str(path))}: {said}$"):
            Journal(path)


def test_what_is_no_file_is_refused_and_no_lock_lies_beside_it(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("/dev/null")
    for path in (tmp_path / "pipe", tmp_path / "link", Path("/dev/null")):
        refused(path, "not a file; move it away, or name another file")
        assert not path.with_name(f"{path.name}.lock").exists()


def test_a_pipe_that_comes_into_its_place_is_not_waited_for(tmp_path):
    class Late(Disk):
        def open(self, path, *, new=False):
            os.mkfifo(path)
            return super().open(path, new=new)

    with pytest.raises(BadInputError, match=r"journal: not a file; move it away"):
        Journal(tmp_path / "journal", Late())


def test_one_beyond_the_limit_is_refused_and_not_cut(tmp_path, monkeypatch):
    path = tmp_path / "journal"
    path.write_bytes(whole(SOME))
    monkeypatch.setattr(journal_disk, "SIZE_MAX", path.stat().st_size)
    with Journal(path) as journal:
        assert journal.entries == SOME
        journal.append(SOME[0])
    refused(path, r"longer than \d+ bytes; move it away, or name another file")
    assert path.read_bytes() == whole([*SOME, SOME[0]])


def test_an_endless_one_takes_no_memory(tmp_path):
    path = tmp_path / "journal"
    path.write_bytes(MAGIC)
    os.truncate(path, 8 << 30)  # a sparse file: on the disk it takes nothing
    tracemalloc.start()
    try:
        refused(path, "longer than 1073741824 bytes; move it away, or name another file")
        assert tracemalloc.get_traced_memory()[1] < 50e6
    finally:
        tracemalloc.stop()
    assert path.stat().st_size == 8 << 30


def test_a_second_one_is_kept_out_until_the_first_ends(tmp_path):
    path = tmp_path / "journal"
    with Journal(path) as first:
        first.append(SOME[0])
        with pytest.raises(JournalLockedError, match="another teleop has this journal open; wait"):
            Journal(path)
        first.rewrite([SOME[1]])  # a new file of the same name is locked likewise
        with pytest.raises(JournalLockedError):
            Journal(path)
    with Journal(path) as second:
        assert second.entries == [SOME[1]]


def test_without_a_lock_file_the_folder_is_locked(tmp_path):
    (tmp_path / "journal.lock").mkdir()  # cannot be opened as a file
    with Journal(tmp_path / "journal"):
        with pytest.raises(JournalLockedError):
            Journal(tmp_path / "journal")
    Journal(tmp_path / "journal").close()


def test_room_for_a_lock_file_lets_no_second_teleop_in(tmp_path):
    """The disk was full when the first one started, so it has the folder."""
    path, taken = tmp_path / "journal", tmp_path / "journal.lock"
    taken.mkdir()
    with Journal(path) as first:
        taken.rmdir()
        with pytest.raises(JournalLockedError):
            Journal(path)
        first.append(SOME[0])
        with Journal(tmp_path / "another folder" / "journal"):
            pass
    with Journal(path) as second:
        assert second.entries == SOME[:1]


def test_without_a_lock_file_a_second_writer_is_refused(tmp_path):
    path = tmp_path / "journal"
    with Journal(path):
        (tmp_path / "journal.lock").unlink()
        (tmp_path / "journal.lock").mkdir()
        with pytest.raises(JournalLockedError):
            Journal(path)
        with Journal(tmp_path / "of another mission"):
            pass


def test_a_rewritten_one_goes_on(tmp_path):
    path = tmp_path / "journal"
    with Journal(path) as journal:
        for entry in SOME:
            journal.append(entry)
        journal.rewrite(SOME[2:])
        journal.append(SOME[0])
    assert path.read_bytes() == whole([*SOME[2:], SOME[0]])


def test_nothing_is_left_open(tmp_path):
    def handles():
        return len(os.listdir("/proc/self/fd"))

    path = tmp_path / "journal"
    write(path, SOME)
    before = handles()
    for _ in range(3):
        path.write_bytes(path.read_bytes().replace(b"event", b"tneve", 1))
        write(path, SOME)
        with pytest.raises(OSError, match="Is a directory"):
            Journal(tmp_path)
    assert handles() == before


def test_a_folder_that_cannot_be_made_is_an_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="file"):
        Journal(tmp_path / "file" / "journal")


def test_folder_and_lock_are_made_and_the_lock_is_private(tmp_path):
    path = tmp_path / "a" / "b" / "journal"
    before = os.umask(0)
    try:
        Journal(path).close()
    finally:
        os.umask(before)
    assert path.with_name("journal.lock").stat().st_mode & 0o777 == 0o600
    assert path.stat().st_mode & 0o777 == 0o600


def test_what_an_earlier_crash_left_is_written_over(tmp_path):
    path = tmp_path / "journal"
    rubbish = b"rubbish" * 1000
    (tmp_path / "journal.new").write_bytes(rubbish)
    (tmp_path / "journal.damaged").write_bytes(rubbish)
    damaged = b"?" + whole(SOME)[1:]
    path.write_bytes(damaged)
    with Journal(path) as journal:
        assert journal.entries == SOME
    assert path.read_bytes() == whole(SOME)
    assert (tmp_path / "journal.damaged").read_bytes() == damaged


def test_a_rewrite_that_fails_leaves_no_file_behind(tmp_path):
    class Refusing(Disk):
        def replace(self, new, path):
            raise OSError(5, "Input/output error")

    path = tmp_path / "journal"
    with Journal(path, Refusing()) as journal:
        journal.append(SOME[0])
        with pytest.raises(OSError, match="Input/output"):
            journal.rewrite(SOME)
        assert not (tmp_path / "journal.new").exists()
        journal.append(SOME[1])
    assert path.read_bytes() == whole(SOME[:2])


def test_removing_what_is_not_there_is_done(tmp_path):
    Disk().remove(tmp_path / "none")
