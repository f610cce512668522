"""World's epochs rise through restarts, crashes and disks that fail."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable
from pathlib import Path
from queue import SimpleQueue

import pytest

from cloudrc.drivers import epochs
from cloudrc.drivers.epochs import BLOCK, EpochFile, replace_durably
from cloudrc.tunnel.handshake import EPOCH_MAX

WAIT = 10.0
"""Longest wait for a thread [s]."""


class Told(deque[range]):
    """A list that signals each append."""

    def __init__(self, blocks: Iterable[range]) -> None:
        super().__init__(blocks)
        self.appended: SimpleQueue[None] = SimpleQueue()

    def append(self, block: range) -> None:
        super().append(block)
        self.appended.put(None)


class Slow:
    """An epoch file on a disk that writes only when a test allows it."""

    def __init__(self, path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.troubles: list[str] = []
        self.asked: SimpleQueue[bytes] = SimpleQueue()
        self._goes_on: SimpleQueue[None] = SimpleQueue()
        self.file = EpochFile(path, self.troubles.append)
        self._reserved = Told(self.file._reserved)
        self.file._reserved = self._reserved
        monkeypatch.setattr(epochs, "replace_durably", self._write)

    def _write(self, path: Path, data: bytes) -> None:
        self.asked.put(data)
        self._goes_on.get(timeout=WAIT)
        replace_durably(path, data)

    def take(self, count: int) -> list[int]:
        """Take `count` epochs, which must all be available."""
        taken = [self.file.take() for _ in range(count)]
        assert None not in taken
        return [epoch for epoch in taken if epoch is not None]

    def go_on(self) -> None:
        """Let the disk write one block and wait for it."""
        self._goes_on.put(None)
        self._reserved.appended.get(timeout=WAIT)


Opened = Callable[[Path], EpochFile]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "epoch"


@pytest.fixture
def troubles() -> list[str]:
    return []


@pytest.fixture
def opened(troubles: list[str]) -> Opened:
    return lambda path: EpochFile(path, troubles.append)


@pytest.fixture
def slow(path: Path, monkeypatch: pytest.MonkeyPatch) -> Slow:
    return Slow(path, monkeypatch)


def test_epochs_begin_with_one_and_rise(path: Path, opened: Opened, troubles: list[str]) -> None:
    file = opened(path)
    assert [file.take() for _ in range(3)] == [1, 2, 3]
    assert troubles == []


def test_a_restart_at_any_moment_never_hands_out_an_epoch_again(
    path: Path, opened: Opened, monkeypatch: pytest.MonkeyPatch
) -> None:
    used: list[int | None] = []
    for taken in (3, 0, 1, BLOCK, 1):
        file = opened(path)
        used += [file.take() for _ in range(taken)]
    slow = Slow(path, monkeypatch)
    used += slow.take(BLOCK)
    slow.go_on()
    used += slow.take(2)
    monkeypatch.undo()
    used.append(opened(path).take())
    assert used == sorted(set(used))


def test_an_epoch_is_on_disk_before_it_is_used(path: Path, slow: Slow) -> None:
    for taken in (BLOCK // 2, BLOCK, BLOCK):
        for _ in range(taken):
            assert slow.take(1)[0] <= int(path.read_text())
        slow.go_on()


def test_the_next_block_is_reserved_well_before_the_last_ends(
    slow: Slow,
) -> None:
    slow.take(BLOCK // 2 - 1)
    assert slow.asked.empty()
    for last in (2 * BLOCK, 3 * BLOCK):
        slow.take(1)
        assert slow.asked.get(timeout=WAIT) == b"%d\n" % last
        slow.go_on()
        slow.take(BLOCK - 1)
        assert slow.asked.empty()


def test_a_hanging_disk_blocks_nobody_and_gives_no_epoch(
    path: Path, slow: Slow, opened: Opened, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert slow.take(BLOCK) == list(range(1, BLOCK + 1))
    assert [slow.file.take() for _ in range(3)] == [None] * 3
    slow.go_on()
    assert slow.take(2) == [BLOCK + 1, BLOCK + 2]
    assert slow.troubles == []
    monkeypatch.undo()
    assert opened(path).take() == 2 * BLOCK + 1


def test_a_disk_failure_in_flight_is_reported_and_epochs_rise(path: Path, slow: Slow) -> None:
    path.unlink()
    path.parent.rmdir()
    taken = slow.take(BLOCK)
    slow.go_on()
    assert taken + slow.take(1) == list(range(1, BLOCK + 2))
    (trouble,) = slow.troubles
    assert "are not kept through a restart" in trouble


def test_it_is_flushed_before_it_takes_the_old_ones_place(
    path: Path, opened: Opened, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[str] = []
    fsync, replace = os.fsync, Path.replace
    monkeypatch.setattr(os, "fsync", lambda fd: (calls.append("fsync"), fsync(fd))[1])
    monkeypatch.setattr(Path, "replace", lambda a, b: (calls.append("rename"), replace(a, b))[1])
    opened(path)
    assert calls == ["fsync", "rename", "fsync"]


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_a_crash_between_the_steps_leaves_the_old_file_whole(
    path: Path, step: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    replace_durably(path, b"7\n")

    def crash(*given: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(*((os, "fsync") if step == "fsync" else (Path, "replace")), crash)
    with pytest.raises(OSError, match="No space"):
        replace_durably(path, b"8\n")
    assert path.read_bytes() == b"7\n"
    assert [p.name for p in path.parent.iterdir()] == ["epoch"]


@pytest.mark.parametrize(
    "torn",
    [b"", b"12x", b"-4", b"99999999999", b"9" * 5000, b"\xff\xfe"],
    ids=lambda torn: torn[:9],
)
def test_a_file_without_an_epoch_is_reported_and_epochs_restart(
    path: Path, opened: Opened, troubles: list[str], torn: bytes
) -> None:
    path.write_bytes(torn)
    file = opened(path)
    kept = path.with_name("epoch.no-epoch")
    assert troubles[0] == (
        f"{path}: holds no epoch and was renamed {kept.name}; epochs begin again"
    )
    assert kept.read_bytes() == torn
    assert file.take() == 1
    assert opened(path).take() == BLOCK + 1


def test_a_pipe_in_the_place_of_the_file_is_not_waited_for(
    path: Path, opened: Opened, troubles: list[str]
) -> None:
    os.mkfifo(path)
    assert opened(path).take() == 1
    assert troubles[0].startswith(f"{path}: holds no epoch and was renamed ")


def test_an_unreadable_file_is_reported_and_epochs_restart(
    path: Path, opened: Opened, troubles: list[str]
) -> None:
    path.mkdir()
    assert opened(path).take() == 1
    assert troubles[0].startswith(f"{path}: ")
    assert "epochs begin again" in troubles[0]


def test_a_read_only_disk_is_reported_and_epochs_rise(
    tmp_path: Path, opened: Opened, troubles: list[str]
) -> None:
    file = opened(tmp_path / "no" / "epoch")
    assert "are not kept through a restart" in troubles[0]
    assert [file.take(), file.take()] == [1, 2]


@pytest.mark.parametrize("last", [EPOCH_MAX, EPOCH_MAX - 1, EPOCH_MAX - BLOCK])
def test_after_the_last_epoch_comes_the_first(
    path: Path, last: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    path.write_text(str(last))
    slow = Slow(path, monkeypatch)
    taken = slow.take(BLOCK // 2)
    slow.go_on()
    taken += slow.take(BLOCK // 2 + 1)
    assert max(taken) <= EPOCH_MAX
    assert 1 in taken
