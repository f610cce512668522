"""A restart shortens a journal that has filled its volume, with the room of the reserve."""

from __future__ import annotations

import errno
import shutil
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from cloudrc.assembly import build_plan
from cloudrc.cli import teleop
from cloudrc.cli.main import main
from cloudrc.config.load import load_experiment
from cloudrc.config.shipped import FOLDERS
from cloudrc.teleop.journal import Entry, Journal, parse, to_bytes
from cloudrc.teleop.store import KEPT, QUEUE_MAX, MissionStore, Order
from tests.cli.conftest import MIB, KilledError, Volume

RESERVE = MIB // 8
"""Size of the reserve here [bytes]: small, so that a short journal needs as much room."""
LEFT = KEPT + 1
"""Missions that a start keeps: a new mission removes the oldest one when it is ordered."""
HOVER = load_experiment("hover")
Printed = pytest.CaptureFixture[str]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    folder = tmp_path / "volume"
    folder.mkdir()
    return folder / "missions.journal"


@pytest.fixture
def reserve(path: Path) -> Path:
    return path.with_name("missions.journal.reserve")


@pytest.fixture
def volume(path: Path, monkeypatch: pytest.MonkeyPatch) -> Volume:
    """The disk of the journal and of the files beside it."""
    disk = Volume(path.parent)
    monkeypatch.setattr(teleop, "RESERVE_SIZE", RESERVE)
    monkeypatch.setattr(teleop, "free_space", lambda folder: max(disk.room - disk.used, 0))
    monkeypatch.setattr("cloudrc.teleop.journal.Disk", lambda: disk)
    return disk


@cache
def over(count: int) -> list[Entry]:
    """Return entries of missions that were cancelled before they began."""
    entries: list[Entry] = []
    book, order = MissionStore(entries.append, [], bytes(16)), Order(build_plan(HOVER))
    for _ in range(count):
        book.cancel(book.add(order))
    return entries


def start(path: Path) -> str:
    """Let teleop open its journal and end; return the trouble that it reports."""
    with Journal(path) as journal:
        teleop._open_service(HOVER, journal)
        return journal.trouble


def fill(path: Path, volume: Volume, count: int = KEPT + 900) -> None:
    """Let the journal fill the volume."""
    volume.room = 64 * MIB
    with Journal(path) as journal:
        journal.rewrite(over(count))
    volume.room = volume.used


def missions(path: Path) -> int:
    return len({entry["mission"] for entry in parse(path.read_bytes()).entries})


def names(path: Path) -> set[str]:
    return {each.name.removeprefix(path.name) for each in path.parent.iterdir()}


@pytest.mark.parametrize("error", [errno.ENOSPC, errno.EDQUOT])
def test_a_restart_shortens_a_journal_on_a_full_volume(
    error: int, path: Path, reserve: Path, volume: Volume, capsys: Printed
) -> None:
    start(path)
    for _ in range(2):  # not only once
        fill(path, volume)
        volume.error = error
        assert start(path) == ""
        assert missions(path) == LEFT
        assert reserve.stat().st_size == RESERVE
        assert reserve.stat().st_mode & 0o777 == 0o600
        with Journal(path) as journal:
            journal.append(over(1)[0])  # there is room again
    assert names(path) == {"", ".lock", ".reserve"}
    assert capsys.readouterr().err == ""


def test_the_reserve_has_room_for_all_missions_of_the_paper() -> None:
    """Each mission writes entries like these."""
    entries: list[Entry] = []
    plan = build_plan(load_experiment("paper"))
    book = MissionStore(entries.append, [], bytes(16))
    mission = book.add(Order(plan, "paper", "k" * 36))
    for event in ("starting", "started", *["reached"] * len(plan.legs), "done"):
        book.note(mission, event, "waypoint 7 of 7 reached", world="0" * 32)
    assert 4 * (KEPT + QUEUE_MAX + 1) * len(to_bytes(entries)) < teleop.RESERVE_SIZE


def test_the_reserve_takes_real_space_and_is_made_once(
    path: Path, reserve: Path, volume: Volume
) -> None:
    start(path)
    before = reserve.stat()
    assert before.st_blocks * 512 >= RESERVE
    start(path)
    after = reserve.stat()
    assert (after.st_ino, after.st_mtime_ns) == (before.st_ino, before.st_mtime_ns)


def test_a_partial_reserve_or_a_symbolic_link_is_replaced(
    path: Path, reserve: Path, volume: Volume
) -> None:
    precious = path.parent.with_name("precious")
    precious.write_bytes(b"precious")
    reserve.symlink_to(precious)
    start(path)
    assert not reserve.is_symlink()
    assert precious.read_bytes() == b"precious"
    reserve.write_bytes(bytes(MIB))
    start(path)
    assert reserve.stat().st_size == RESERVE


@pytest.mark.parametrize("there", [False, True])
def test_without_room_teleop_reports_it_and_continues(
    there: bool, path: Path, reserve: Path, volume: Volume, capsys: Printed
) -> None:
    """There is no reserve, or another program takes its room."""
    if there:
        start(path)
    fill(path, volume)
    entries, volume.room = path.read_bytes(), volume.room - RESERVE * there
    trouble = start(path)
    assert trouble == (
        f"{path}: cannot be shortened to the missions still known: No space left on device; "
        "once it is full no mission can start: free space or repair the volume, then restart "
        "teleop"
    )
    assert capsys.readouterr().err == f"cloudrc teleop: {trouble}\n"
    assert path.read_bytes() == entries
    assert names(path) == {"", ".lock"}  # the journal needs the room now
    volume.room = 64 * MIB  # somebody frees space
    assert start(path) == ""
    assert missions(path) == LEFT
    assert reserve.stat().st_size == RESERVE


def test_a_journal_that_cannot_be_shortened_is_published(
    path: Path, volume: Volume, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, handlers: None
) -> None:
    fill(path, volume)
    told: list[Any] = []
    monkeypatch.setattr(teleop, "_fly", lambda *words: told.extend(words))
    words = ["--socket", str(tmp_path), "--journal", str(path)]
    assert main(["teleop", "--config", str(FOLDERS["experiment"] / "hover.yaml"), *words]) == 0
    assert "free space or repair the volume" in told[-1]


@pytest.mark.parametrize("error", [errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO])
@pytest.mark.parametrize("operation", ["open", "write", "sync", "remove"])
def test_teleop_starts_without_a_reserve(
    operation: str, error: int, path: Path, reserve: Path, volume: Volume, capsys: Printed
) -> None:
    ending = ".reserve" if operation in ("open", "remove") else ""
    with Journal(path) as journal:
        journal.rewrite(over(1))
    volume.refused = (operation, ending, error)
    with Journal(path) as journal:
        service = teleop._open_service(HOVER, journal)
        assert list(service.book.missions) == ["m1"]
        assert journal.trouble == ""
    assert not reserve.exists()
    assert capsys.readouterr().err == (
        f"cloudrc teleop: {reserve}: refused: without it a restart cannot shorten a journal that "
        "has filled its volume; free space or repair the volume\n"
    )


def test_the_reserve_leaves_room_for_entries(path: Path, reserve: Path, volume: Volume) -> None:
    for room in (RESERVE // 2, RESERVE, 2 * RESERVE - 1):  # entries need room as well
        volume.room = room
        start(path)
        assert not reserve.exists()
    volume.room = 2 * RESERVE + volume.used
    start(path)
    assert reserve.stat().st_size == RESERVE


def test_room_is_the_free_space_of_the_volume(tmp_path: Path) -> None:
    free = shutil.disk_usage(tmp_path).free
    assert teleop.free_space(tmp_path) == pytest.approx(free, abs=free / 10)


def test_another_error_keeps_the_reserve(path: Path, reserve: Path, volume: Volume) -> None:
    start(path)
    fill(path, volume)
    volume.room, volume.refused = 64 * MIB, ("replace", "", errno.EIO)
    assert "refused; once it is full no mission can start" in start(path)
    assert reserve.stat().st_size == RESERVE


def kills(path: Path, volume: Volume) -> Iterator[int]:
    """Start teleop on a full volume and kill it, once before each of its operations."""
    at = 0
    while True:
        volume.room, volume.kill_at = 64 * MIB, -1
        start(path)
        fill(path, volume)
        volume.steps, volume.kill_at = 0, at
        try:
            start(path)
        except KilledError:
            volume.kill_at = -1
            yield at
        else:
            return
        at += 1


def test_after_a_kill_at_any_step_a_start_repairs_both_files(
    path: Path, reserve: Path, volume: Volume
) -> None:
    count = 0
    for _ in kills(path, volume):
        assert start(path) == ""
        assert missions(path) == LEFT
        assert reserve.stat().st_size == RESERVE
        assert names(path) == {"", ".lock", ".reserve"}
        count += 1
    assert count > 20
