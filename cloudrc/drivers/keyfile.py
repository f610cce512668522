"""Read the key file of an end, and follow its changes in flight, since a Secret may be rotated."""

from __future__ import annotations

from pathlib import Path

from cloudrc.errors import BadInputError
from cloudrc.files import read, version
from cloudrc.records import Fault
from cloudrc.tunnel.keys import KeyRing, KeySet, parse

PERIOD_NS = 500_000_000
"""Time between two checks of the file [ns]; a check is one system call while nothing changes."""
SIZE_MAX = 4096
"""Size limit of a key file [bytes]."""


class KeyFile:
    """Follows the key file of one end of the tunnel; `ring` always holds the valid keys."""

    def __init__(self, path: Path, now_ns: int) -> None:
        """Read the file at `now_ns` [ns, monotonic clock]; raise the errors of `read_keys`."""
        self._path, self._due_ns, self._trouble = path, now_ns, ""
        self._seen = version(path)
        self.ring = KeyRing(read_keys(path))

    def follow(self, now_ns: int) -> list[Fault]:
        """Check the file for changes, if a check is due at `now_ns` [ns, monotonic clock].

        Return records of a new key or of the reason to keep the old keys.
        """
        if now_ns < self._due_ns:
            return []
        self._due_ns = now_ns + PERIOD_NS
        seen, last, before = version(self._path), self._trouble, self.ring.keys
        if seen == self._seen or seen is None:  # ignore a file that is missing for a moment
            return []
        self._seen, self._trouble = seen, ""
        try:
            keys = read_keys(self._path)
        except BadInputError as error:
            self._seen = None  # try again: `version` does not show a change of permissions
            self._trouble = f"the old keys stay in use: {error}"
            return [] if last == self._trouble else [Fault(now_ns, "key", self._trouble)]
        if keys == before:
            return []
        self.ring.keys = keys
        new = "new " if keys.current != before.current else ""
        also = f"{keys.previous.name} is accepted, too" if keys.previous else "no other is accepted"
        return [Fault(now_ns, "key", f"{new}key {keys.current.name}; {also}")]


def read_keys(path: Path, named: str = "--key ") -> KeySet:
    """Read a key file without waiting, even if it is a pipe; `named` is the option that names it.

    Raise a BadInputError if the file holds no key. The message quotes no part of the file.
    """
    try:
        return parse(read(path, SIZE_MAX))
    except OSError as error:
        reason = error.strerror or str(error)
    except ValueError as error:
        reason = str(error).removeprefix(f"{path}: ")
    raise BadInputError(f"{named}{path}: {reason}; make one: cloudrc key new FILE")
