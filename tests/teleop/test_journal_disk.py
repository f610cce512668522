"""The journal on a disk that is killed, full, read-only or forgetful: nothing whole is lost."""

import errno

import pytest

from cloudrc.teleop.journal import MAGIC, Journal, parse
from tests.teleop.conftest import PATH, KilledError, MemoryDisk, full, refusing

NEW = PATH.with_name("missions.journal.new")
SOME = [{"kind": "event", "n": n, "text": "x" * 40} for n in range(4)]


def opened(disk):
    return Journal(PATH, disk)


def on_disk(disk):
    return parse(disk.read(PATH)).entries


def kills(script):
    """Run a script on new disks, killed before its every operation; disk and what came before."""
    steps = None
    at = 0
    while steps is None or at < steps:
        for crash in (
            {},
            {"power": True},
            {"power": True, "kept": 0.6},
            {"power": True, "kept": 1.0},
        ):
            disk, before = MemoryDisk(), []
            disk.kill_at = at
            try:
                script(disk, before)
            except KilledError:
                disk.crash(**crash)
                yield disk, before
            else:
                steps = at
                break
        at += 1


def append_all(disk, done):
    with opened(disk) as journal:
        for entry in SOME:
            journal.append(entry)
            done.append(entry)


def test_an_appended_entry_survives_a_kill_at_any_step():
    count = 0
    for disk, done in kills(append_all):
        with opened(disk) as journal:
            found = journal.entries
            # The one that was being written may be there, or not.
            assert found in (done, SOME[: len(done) + 1])
            journal.append({"n": 99})
        assert on_disk(disk) == [*found, {"n": 99}]
        count += 1
    assert count > 40


def test_an_entry_is_synced_before_it_counts():
    disk = MemoryDisk()
    with opened(disk) as journal:
        for entry in SOME:
            journal.append(entry)
            assert disk.done[-1] == "sync"
    assert disk.done.count("sync_folder") == 1  # the name is new but once
    disk.crash(power=True)
    assert on_disk(disk) == SOME


def test_a_killed_rewrite_leaves_the_old_or_the_new_journal():
    def script(disk, done):
        with opened(disk) as journal:
            for entry in SOME:
                journal.append(entry)
            done.append("written")
            journal.rewrite(SOME[2:])
            done.append("rewritten")
            journal.append({"n": 99})
            done.append("appended")

    seen = set()
    for disk, done in kills(script):
        if not done:
            continue
        with opened(disk) as journal:
            found = journal.entries
        expected = {
            1: (SOME, SOME[2:]),
            2: (SOME[2:], [*SOME[2:], {"n": 99}]),
        }[len(done)]
        assert found in expected
        seen.add((len(done), expected.index(found)))
    assert seen == {(1, 0), (1, 1), (2, 0), (2, 1)}


def test_a_killed_repair_is_finished_at_the_next_start():
    def script(disk, done):
        if not disk.names:  # damage in the middle and a torn end
            kill_at, disk.kill_at = disk.kill_at, None
            with opened(disk) as journal:
                for entry in SOME:
                    journal.append(entry)
            (file,) = disk.names.values()
            disk.bytes[file] = disk.bytes[file].replace(b'"n":1', b'"n":7')[:-5]
            disk.safe_bytes = list(disk.bytes)
            disk.kill_at, disk.steps = kill_at, 0
        opened(disk).close()

    count = 0
    for disk, _ in kills(script):
        with opened(disk) as journal:
            assert journal.entries == [SOME[0], SOME[2]]
        count += 1
    assert count > 20


def test_a_full_disk_leaves_the_journal_unchanged_until_freed():
    disk = MemoryDisk()
    with opened(disk) as journal:
        journal.append(SOME[0])
        for after in (0, 1, 3):
            disk.fault = full(after)
            with pytest.raises(OSError, match="No space left"):
                journal.append(SOME[1])
            assert disk.done[-2:] == ["truncate", "sync"]
            assert on_disk(disk) == [SOME[0]]
        disk.fault = lambda name: None
        journal.append(SOME[2])
    assert on_disk(disk) == [SOME[0], SOME[2]]
    with opened(disk) as journal:
        assert (journal.entries, journal.trouble) == ([SOME[0], SOME[2]], "")


def test_what_could_not_be_undone_is_cut_before_the_next_entry():
    disk = MemoryDisk()
    with opened(disk) as journal:
        journal.append(SOME[0])
        disk.fault = refusing("truncate", "sync", error=errno.EIO)
        with pytest.raises(OSError):  # noqa: PT011
            journal.append(SOME[1])
        assert on_disk(disk) == SOME[:2]  # it was refused, and must not come back
        disk.fault = lambda name: None
        journal.append(SOME[2])
    assert on_disk(disk) == [SOME[0], SOME[2]]


def test_a_full_disk_refuses_a_rewrite_and_keeps_the_old():
    for fault in (full(), refusing("replace"), refusing("sync"), refusing("replace", "remove")):
        disk = MemoryDisk()
        with opened(disk) as journal:
            for entry in SOME:
                journal.append(entry)
            handles = len(disk.handles)
            disk.fault = fault
            with pytest.raises(OSError):  # noqa: PT011
                journal.rewrite(SOME[3:])
            disk.fault = lambda name: None
            assert set(disk.names) - {NEW} == {PATH}  # the new one stays where it cannot go
            assert len(disk.handles) == handles
            journal.append(SOME[0])
        assert on_disk(disk) == [*SOME, SOME[0]]


def test_a_new_name_that_is_not_safe_keeps_entries_out():
    """Else a loss of power brings the old file back, without what was appended to the new one."""
    disk = MemoryDisk()
    with opened(disk) as journal:
        journal.append(SOME[0])
        disk.fault = refusing("sync_folder", error=errno.EIO)
        with pytest.raises(OSError):  # noqa: PT011
            journal.rewrite(SOME[:1])
        with pytest.raises(OSError):  # noqa: PT011
            journal.append(SOME[1])
        disk.fault = lambda name: None
        journal.append(SOME[2])
    disk.crash(power=True)
    assert on_disk(disk) == [SOME[0], SOME[2]]


def written():
    disk = MemoryDisk()
    with opened(disk) as journal:
        for entry in SOME:
            journal.append(entry)
    return disk


@pytest.mark.parametrize("error", [errno.EROFS, errno.EACCES, errno.ENOSPC, errno.EDQUOT])
def test_a_read_only_disk_is_read_and_written_to_later(error):
    disk = written()
    disk.fault = refusing("open", error=error)
    with opened(disk) as journal:
        assert journal.entries == SOME
        assert journal.trouble.endswith("missions are refused until it is not")
        assert str(PATH) in journal.trouble
        assert not journal.repaired
        for _ in range(2):
            with pytest.raises(OSError, match="Read-only"):
                journal.append({"n": 99})
        disk.fault = lambda name: None
        journal.append({"n": 99})
    assert on_disk(disk) == [*SOME, {"n": 99}]


def test_any_other_refusal_is_an_error():
    disk = written()
    disk.fault = refusing("open", error=errno.EIO)
    with pytest.raises(OSError):  # noqa: PT011
        opened(disk)
    assert not disk.locked


@pytest.mark.parametrize("where", ["end", "middle"])
def test_damage_on_a_read_only_disk_is_repaired_later(where):
    disk = written()
    file = disk.names[PATH]
    data = disk.bytes[file]
    data = data[:-4] if where == "end" else data.replace(b'"n":1', b'"n":7')
    disk.bytes[file] = data
    kept = SOME[:3] if where == "end" else [SOME[0], *SOME[2:]]
    disk.fault = refusing("open")
    with opened(disk) as journal:
        assert journal.entries == kept
        assert "journal repaired" in journal.trouble
        assert journal.trouble.endswith("; it could not be written: Read-only file system")
        assert "until it is not; journal repaired: " in journal.trouble
        disk.fault = lambda name: None
        journal.append({"n": 99})
    assert on_disk(disk) == [*kept, {"n": 99}]


def test_the_first_entry_brings_the_head():
    disk = MemoryDisk()
    with opened(disk) as journal:
        assert disk.read(PATH) == b""
        disk.fault = full(1)
        with pytest.raises(OSError, match="No space"):
            journal.append(SOME[0])
        assert disk.read(PATH) == b""
        disk.fault = lambda name: None
        journal.append(SOME[0])
    assert disk.read(PATH).startswith(MAGIC)


def test_a_disk_back_during_opening_gets_its_journal_repaired():
    disk = written()
    file = disk.names[PATH]
    disk.bytes[file] = disk.bytes[file].replace(b'"n":1', b'"n":7')
    refused = []

    def once(name):
        if name == "open" and not refused:
            refused.append(name)
            raise OSError(errno.EROFS, "Read-only file system")

    disk.fault = once
    with opened(disk) as journal:
        assert journal.entries == [SOME[0], *SOME[2:]]
        journal.append({"n": 99})
    assert on_disk(disk) == [SOME[0], *SOME[2:], {"n": 99}]
    assert not disk.handles
