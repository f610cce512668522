"""An unreadable sector costs only its own data."""

from __future__ import annotations

import errno
import io
from pathlib import Path
from typing import Any

import pytest

from cloudrc.record.columns import Recording
from cloudrc.record.recover import SECTOR, Sectors, recover
from tests.record.conftest import world_records, write


class Failing(io.FileIO):
    """A file with some unreadable sectors."""

    bad: frozenset[int] = frozenset()
    code = errno.EIO

    def readinto(self, buffer: Any, /) -> int | None:
        at, view = self.tell(), memoryview(buffer)
        for number in range(at // SECTOR, (at + len(view) - 1) // SECTOR + 1):
            if number in self.bad:
                if number * SECTOR <= at:
                    raise OSError(self.code, "it is broken")
                return super().readinto(view[: number * SECTOR - at])
        return super().readinto(view)


def failing(path: Path, *bad: int) -> Failing:
    file = Failing(str(path), "r")
    file.bad = frozenset(bad)
    return file


def test_bad_sectors_read_as_zeros_and_are_told(tmp_path: Path) -> None:
    data = bytes(range(1, 251)) * 100
    path = tmp_path / "f"
    path.write_bytes(data)
    for start, size in ((0, 25_000), (4_000, 200), (8_000, 9_000), (24_000, 5_000), (9, 0)):
        with Sectors(failing(path, 1, 3)) as file:
            file.seek(start)
            expected = bytearray(data)
            for number in (1, 3):
                expected[number * SECTOR : (number + 1) * SECTOR] = bytes(SECTOR)
            assert file.read(size) == expected[start : start + size]
            assert file.tell() == min(start + size, len(data))
            assert file.bad <= {1, 3}


def test_another_error_is_one(tmp_path: Path) -> None:
    path = tmp_path / "f"
    path.write_bytes(bytes(9_000))
    raw = failing(path, 1)
    raw.code = errno.EBADF
    with Sectors(raw) as file, pytest.raises(OSError, match="it is broken"):
        file.read(9_000)


@pytest.mark.parametrize("place", ["first", "middle", "last"])
def test_a_recording_on_a_failing_disk_loses_what_lies_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str
) -> None:
    path, new = write(tmp_path / "w.mcap", world_records(500)), tmp_path / "new.mcap"
    last = path.stat().st_size // SECTOR
    bad = {"first": 0, "middle": last // 2, "last": last}[place]
    opened = Path.open

    def fails(self: Path, *args: Any, **more: Any) -> Any:
        return failing(path, bad) if self == path else opened(self, *args, **more)

    monkeypatch.setattr(Path, "open", fails)
    recovery = recover(path, new)
    assert "1 sectors of 4096 bytes cannot be read" in recovery.notes
    assert len(Recording.read(new)["/odometry"]) >= 350
