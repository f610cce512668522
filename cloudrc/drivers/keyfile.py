"""The key file: read at the start, and followed in flight, since a Secret may be rotated.

The loop looks at it twice a second, as at the route: one system call as long as nothing changes.
"""

from __future__ import annotations

import stat
from pathlib import Path

from cloudrc.errors import BadInputError
from cloudrc.files import read, version
from cloudrc.records import Fault
from cloudrc.tunnel.keys import KeyRing, KeySet, parse

PERIOD_NS = 500_000_000
"""How often it is asked whether the file has changed [ns]."""
SIZE_MAX = 4096
"""Of a key file [bytes]."""
MAKE = "make one: cloudrc key new FILE"


class KeyFile:
    """The keys of one end; `ring` always holds those that are valid."""

    def __init__(self, path: Path, now_ns: int, wall: float | None = None) -> None:
        """Read the file for the first time.

        Args:
            path: Of the file.
            now_ns: Monotonic clock [ns].
            wall: What the wall clock says [s since 1970], to find a previous key whose time is
                over; None to go without.

        Raises:
            BadInputError: If it is not there or holds no key.
        """
        self._path = path
        self._seen = version(path)
        self._keys = read_keys(path)
        self._due_ns, self._trouble = now_ns, ""
        self.ring = KeyRing(self._keys, now_ns, wall)
        self._caution = "" if wall is None else self._keys.caution(wall)

    def follow(self, now_ns: int) -> list[Fault]:
        """Look whether the file has changed, if that is due [ns, monotonic clock].

        Returns:
            What is to be told: a new key, why the old ones stay, and at first what is wrong with
            the key before.
        """
        if now_ns < self._due_ns:
            return []
        self._due_ns = now_ns + PERIOD_NS
        told, self._caution = self._caution, ""
        return [Fault(now_ns, "key", told)] if told else self._look(now_ns)

    def _look(self, now_ns: int) -> list[Fault]:
        seen = version(self._path)
        if seen == self._seen or seen is None:  # a file that is gone for a moment changes nothing
            return []
        self._seen = seen
        try:
            keys = read_keys(self._path)
        except BadInputError as error:
            self._seen = None  # who may read it leaves no trace in what is seen of a file
            told, self._trouble = self._trouble, f"the keys stay as they were: {error}"
            return [] if told == self._trouble else [Fault(now_ns, "key", self._trouble)]
        self._trouble = ""
        if keys == self._keys:
            return []
        before, self._keys = self.ring.current, keys
        self.ring.replace(keys, now_ns)
        name = keys.current.name
        if keys.current != before:
            text = f"new key {name}; the one before is valid for {keys.overlap:g} s more"
        elif keys.previous is None:
            text = f"key {name} alone; the one before is not valid any more"
        else:
            text = f"key {name} as before; what is said of the one before changed"
        return [Fault(now_ns, "key", text)]


def read_keys(path: Path, named: str = "--key ", remedy: str = MAKE) -> KeySet:
    """Read a key file, without waiting for anybody.

    Args:
        path: Of the file.
        named: By which flag.
        remedy: What to do if it holds no key.

    Raises:
        BadInputError: What is wrong with it and what to do, without a word of it.
    """
    try:
        data = read(path, SIZE_MAX)
    except OSError as error:
        raise BadInputError(f"{named}{path}: {error.strerror or error}; {remedy}") from None
    except ValueError as error:  # which names the file
        raise BadInputError(f"{named}{error}; {remedy}") from None
    try:
        return parse(data)
    except ValueError as error:
        raise BadInputError(f"{named}{path}: {error}; {remedy}") from None


def is_exposed(path: Path) -> bool:
    """Whether every user of this machine can read a key file."""
    return bool(path.stat().st_mode & (stat.S_IROTH | stat.S_IWOTH))
