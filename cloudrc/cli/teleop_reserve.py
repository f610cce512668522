"""Room for the journal to be shortened where it has filled its volume: a file that is given up.

What a start takes out of the journal is taken out by writing the rest anew beside it, for which a
full disk has no room; and to wait for the next start would be to wait for ever. So some room is
kept by a file, which is deleted then and made again once the old journal is gone. Names beside the
journal are its own, as that of its lock is; all this happens while the lock is held.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from cloudrc.cli.teleop_api import complain

if TYPE_CHECKING:
    from cloudrc.teleop.journal import Disk, Entry, Journal

RESERVE_SIZE = 2 << 20
"""Of the file [bytes].

What a start leaves are the 100 missions that have ended last, and 17 that have not. The paper's, of
seven waypoints, takes 3.8 kB, all of them 0.45 MB; here is room for 45 waypoints in each. The
chart's volume has 64 MiB, of which the audit log may take 16.
"""
FULL = (errno.ENOSPC, errno.EDQUOT)


def room(folder: Path) -> int:
    """How much a folder's volume has left for this user [bytes]."""
    volume = os.statvfs(folder)
    return volume.f_bavail * volume.f_frsize


def shorten(journal: Journal, known: Sequence[Entry], disk: Disk | None = None) -> str:
    """Leave in the journal what is known alone, also on a full disk; keep room for the next time.

    What the disk refuses stops nobody: the journal is then as before.

    Args:
        journal: Open.
        known: Those of its entries that are to stay.
        disk: Where it is; None for the machine's own.

    Returns:
        What is wrong and what to do about it; "" if nothing.
    """
    reserve = Reserve(journal.path, disk)
    try:
        if len(known) < len(journal.entries):
            _rewrite(journal, known, reserve)
    except OSError as error:  # the reserve stays away: there is more need of its room now
        return (
            f"{journal.path}: cannot be shortened to the missions still known: {error.strerror}; "
            "once it is full no mission can start: free or mend its volume, then restart teleop"
        )
    try:
        reserve.make()
    except OSError as error:
        complain(
            f"{reserve.path}: {error.strerror}: without it a restart cannot shorten a journal that "
            "has filled its volume; free or mend that"
        )
    return ""


def _rewrite(journal: Journal, known: Sequence[Entry], reserve: Reserve) -> None:
    """Write the journal anew, if need be in the room of the reserve."""
    try:
        journal.rewrite(known)
    except OSError as error:
        if error.errno not in FULL or not reserve.give_up():
            raise
        journal.rewrite(known)


class Reserve:
    """A file beside the journal that holds nothing but room.

    Attributes:
        path: Of it.
    """

    def __init__(self, journal: Path, disk: Disk | None = None) -> None:
        """Touch nothing yet.

        Args:
            journal: Path of the journal.
            disk: Where it is; None for the machine's own.
        """
        from cloudrc.teleop.journal import Disk

        self.path, self._disk = journal.with_name(f"{journal.name}.reserve"), disk or Disk()

    def give_up(self) -> bool:
        """Delete it; say whether there was one.

        Raises:
            OSError: If the disk refuses.
        """
        if self._size() is None:
            return False
        self._disk.remove(self.path)
        self._disk.sync_folder(self.path.parent)  # some disks give room back with that alone
        return True

    def make(self) -> None:
        """Make it, unless it is there and whole.

        Raises:
            OSError: If the disk refuses, or has no more room than entries need; there is none then.
        """
        if self._size() == RESERVE_SIZE:
            return
        self._disk.remove(self.path)  # one that a crash has left, or whatever a link leads to
        if room(self.path.parent) < 2 * RESERVE_SIZE:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        file = self._disk.open(self.path, new=True)
        try:
            # Not zeros, nor a hole: a disk that compresses would keep no room for those.
            left = memoryview(os.urandom(RESERVE_SIZE))
            while left:
                left = left[self._disk.write(file, bytes(left)) :]
            self._disk.sync(file)
        except OSError:
            with suppress(OSError):
                self._disk.remove(self.path)
            raise
        finally:
            self._disk.close(file)

    def _size(self) -> int | None:
        """Its length [bytes]; None if there is none."""
        try:
            return self.path.lstat().st_size
        except OSError:
            return None
