"""A disk for the journal with limited room, which can fail or kill the process."""

from __future__ import annotations

import errno
from pathlib import Path

from cloudrc.teleop.journal import Disk

MIB = 1 << 20


class KilledError(BaseException):
    """Stand for the end of the process: nothing catches it."""


class Volume(Disk):
    """A real folder with limited room, which can fail or kill the process.

    Attributes:
        room: Room for all files of the folder [bytes].
        error: Error number when the room is used up.
        refused: Operation that fails, for names with an ending, and the error number.
        steps: Number of operations so far.
        kill_at: Number of the operation before which the process is killed.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.folder, self.room, self.error = folder, 64 * MIB, errno.ENOSPC
        self.refused: tuple[str, str, int] = ("", "", 0)
        self.steps, self.kill_at = 0, -1

    @property
    def used(self) -> int:
        return sum(path.stat().st_size for path in self.folder.iterdir())

    def _step(self, name: str, path: Path | None = None) -> None:
        if self.steps == self.kill_at:
            raise KilledError(name)
        self.steps += 1
        which, ending, error = self.refused
        if name == which and (path is None or path.name.endswith(ending)):
            raise OSError(error, "refused")

    def open(self, path: Path, *, new: bool = False) -> int:
        self._step("open", path)
        return super().open(path, new=new)

    def write(self, file: int, data: bytes) -> int:
        self._step("write")
        room = self.room - self.used
        if room <= 0:
            raise OSError(self.error, "No space left on device")
        return super().write(
            file, data[: min(room, (len(data) + 1) // 2)]
        )  # at most half of it, as in the tests of the journal

    def sync(self, file: int) -> None:
        self._step("sync")  # a crash of the machine is not tested here

    def replace(self, new: Path, path: Path) -> None:
        self._step("replace", path)
        super().replace(new, path)

    def remove(self, path: Path) -> None:
        self._step("remove", path)
        super().remove(path)
