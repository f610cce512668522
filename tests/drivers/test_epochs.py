"""World's epochs rise through restarts, crashes and disks that fail."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from cloudrc.drivers import epochs
from cloudrc.drivers.epochs import BLOCK, EpochFile, replace_durably
from cloudrc.tunnel.handshake import EPOCH_MAX


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "epoch"


def test_epochs_begin_with_one_and_rise(path: Path) -> None:
    file = EpochFile(path)
    assert [file.take() for _ in range(3)] == [1, 2, 3]
    assert file.trouble == ""


def test_a_restart_at_any_moment_never_hands_out_an_epoch_again(path: Path) -> None:
    used: list[int] = []
    for taken in (3, 0, 1, BLOCK + 2, 1):
        file = EpochFile(path)
        used += [file.take() for _ in range(taken)]
    assert used == sorted(set(used))


def test_an_epoch_is_on_disk_before_it_is_used(path: Path) -> None:
    file = EpochFile(path)
    for _ in range(2 * BLOCK + 5):
        assert file.take() <= int(path.read_text())


def test_the_disk_is_asked_at_the_start_and_once_in_a_block(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, asked = EpochFile(path), []
    monkeypatch.setattr(epochs, "replace_durably", lambda path, data: asked.append(data))
    for _ in range(BLOCK):
        file.take()
    assert asked == []
    for _ in range(BLOCK):
        file.take()
    assert asked == [b"%d\n" % (2 * BLOCK)]


def test_it_is_flushed_before_it_takes_the_old_ones_place(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[str] = []
    fsync, replace = os.fsync, Path.replace
    monkeypatch.setattr(os, "fsync", lambda fd: (calls.append("fsync"), fsync(fd))[1])
    monkeypatch.setattr(Path, "replace", lambda a, b: (calls.append("rename"), replace(a, b))[1])
    EpochFile(path)
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
def test_a_file_that_holds_no_epoch_is_told_and_epochs_begin_again(path: Path, torn: bytes) -> None:
    path.write_bytes(torn)
    file = EpochFile(path)
    assert "epochs begin again" in file.trouble
    assert file.take() == 1
    assert EpochFile(path).take() == BLOCK + 1


def test_a_disk_that_cannot_be_written_is_told_and_epochs_rise_all_the_same(tmp_path: Path) -> None:
    file = EpochFile(tmp_path / "no" / "epoch")
    assert "are not kept through a restart" in file.trouble
    assert [file.take(), file.take()] == [1, 2]


@pytest.mark.parametrize("last", [EPOCH_MAX, EPOCH_MAX - 1, EPOCH_MAX - BLOCK])
def test_after_the_last_epoch_comes_the_first(path: Path, last: int) -> None:
    path.write_text(str(last))
    file = EpochFile(path)
    taken = [file.take() for _ in range(BLOCK + 1)]
    assert max(taken) <= EPOCH_MAX
    assert 1 in taken
