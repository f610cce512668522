"""A disk in memory that can be full, refuse, break off at any step, and forget what was not synced.

Names and bytes are kept twice: as the running machine sees them, and as they are on the platter.
"""

import errno
from pathlib import Path

from cloudrc.teleop.journal import MAGIC, to_record


class KilledError(BaseException):
    """The process is gone: nothing catches it."""


class MemoryDisk:
    """Stands for `journal_disk.Disk`.

    Attributes:
        steps: How many operations there have been.
        kill_at: The operation before which the process is killed; None for never.
        fault: Called with the name of every operation; may raise OSError.
    """

    def __init__(self):
        self.steps, self.kill_at = 0, None
        self.fault = lambda name: None
        self.names, self.safe_names = {}, {}  # path -> file
        self.bytes, self.safe_bytes = [], []  # by file
        self.handles, self.locked, self.done = {}, set(), []

    def crash(self, *, power=False, kept=0.0):
        """Begin again after a kill; without power, what was not synced is lost.

        `kept` in [0, 1]: share of the bytes not synced that reached the platter all the same.
        """
        self.handles, self.locked, self.kill_at = {}, set(), None
        self.fault = lambda name: None
        if power:
            self.names = dict(self.safe_names)
            for file, safe in enumerate(self.safe_bytes):
                now = self.bytes[file]
                more = round(kept * (len(now) - len(safe))) if now.startswith(safe) else 0
                self.bytes[file] = safe + now[len(safe) : len(safe) + max(more, 0)]
        self.safe_names = dict(self.names)
        self.safe_bytes = list(self.bytes)

    def _step(self, name):
        if self.kill_at == self.steps:
            raise KilledError(name)
        self.steps += 1
        self.done.append(name)
        self.fault(name)

    def lock(self, path):
        if path in self.locked:
            raise BlockingIOError
        self.locked.add(path)
        self.handles[handle := object()] = path
        return handle

    def open(self, path, *, new=False):
        self._step("open")
        if path not in self.names:
            self.names[path] = len(self.bytes)
            self.bytes.append(b"")
            self.safe_bytes.append(b"")
        file = self.names[path]
        if new:
            self.bytes[file] = b""
        self.handles[handle := object()] = file
        return handle

    def read(self, path):
        return self.bytes[self.names[path]] if path in self.names else b""

    def write(self, handle, data):
        """Half at a time, so that a kill can come between the halves."""
        self._step("write")
        taken = data[: (len(data) + 1) // 2]
        self.bytes[self.handles[handle]] += taken
        return len(taken)

    def size(self, handle):
        return len(self.bytes[self.handles[handle]])

    def truncate(self, handle, size):
        self._step("truncate")
        file = self.handles[handle]
        self.bytes[file] = self.bytes[file][:size]

    def sync(self, handle):
        self._step("sync")
        file = self.handles[handle]
        self.safe_bytes[file] = self.bytes[file]

    def replace(self, new, path):
        self._step("replace")
        self.names[path] = self.names.pop(new)

    def sync_folder(self, folder):
        self._step("sync_folder")
        self.safe_names = dict(self.names)

    def remove(self, path):
        self._step("remove")
        self.names.pop(path, None)

    def close(self, handle):
        self.locked.discard(self.handles.pop(handle))


def full(after=0, error=errno.ENOSPC):
    """A fault: no write succeeds any more, after so many that do."""
    left = [after]

    def fault(name):
        if name == "write":
            left[0] -= 1
            if left[0] < 0:
                raise OSError(error, "No space left on device")

    return fault


def refusing(*names, error=errno.EROFS):
    """A fault: these operations are refused."""

    def fault(name):
        if name in names:
            raise OSError(error, "Read-only file system")

    return fault


PATH = Path("/nowhere/missions.journal")
SOME = [{"kind": "event", "n": n, "text": f"é\n{n}", "limit": float("inf")} for n in range(4)]


def records(some):
    return [to_record(number, entry) for number, entry in enumerate(some, 1)]


def whole(some):
    return MAGIC + b"".join(records(some))
