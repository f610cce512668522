# SPDX-License-Identifier: Apache-2.0

"""Read the key file of world or cloud, and reload it in flight: an operator may rotate the key.

The robots of a fleet have keys of their own, derived from one file: the world of one robot thus
never obeys the cloud of another, even if somebody mixes up their ports.
"""

from __future__ import annotations

import os
from pathlib import Path

from cloudrc.base.errors import CloudrcError
from cloudrc.base.files import Watched, write_atomically
from cloudrc.base.outside.paths import read_secret
from cloudrc.wire.records import Fault
from cloudrc.wire.tunnel.keys import KEY_SIZE, Key, KeyRing, KeySet, parse, write

PERIOD_NS = 500_000_000
"""Time between two checks whether the file has changed [ns]; a check costs one system call."""
SIZE_MAX = 4096
"""Size limit of a key file [bytes]."""


class KeyFile:
    """Reloads the key file of world or cloud when it changes; `ring` holds the valid keys."""

    def __init__(self, path: Path, now_ns: int, robot: int | None = None) -> None:
        """Read the file at `now_ns` [ns, monotonic clock]; raise the errors of `read_keys`.

        `robot` is the number of a robot in a fleet, whose keys are derived from those of the file.
        """
        self._file, self._robot = Watched(path, PERIOD_NS), robot
        self._file.is_new(now_ns)
        self.ring = KeyRing(self._read())

    def follow(self, now_ns: int) -> list[Fault]:
        """Reload the file if it has changed and a check is due at `now_ns` [ns, monotonic clock].

        If the keys have changed, return a record that names the new key. If the file is invalid,
        keep the old keys until it changes again, and return a record of the error.
        """
        if not self._file.is_new(now_ns):
            return []
        before = self.ring.keys
        try:
            keys = self._read()
        except CloudrcError as error:
            return [Fault(now_ns, "key", f"the old keys stay in use: {error}")]
        if keys == before:
            return []
        self.ring.keys = keys
        new = "new " if keys.current != before.current else ""
        also = f"{keys.previous.name} is accepted, too" if keys.previous else "no other is accepted"
        return [Fault(now_ns, "key", f"{new}key {keys.current.name}; {also}")]

    def _read(self) -> KeySet:
        keys = read_keys(self._file.path)
        if self._robot is None:
            return keys
        use = b"robot %d" % self._robot
        return KeySet(*(Key(key.derive(b"", use)) for key in keys.accepted))  # HKDF-SHA256


def read_keys(path: Path, named: str = "--key ") -> KeySet:
    """Read a key file, as `read_secret` does; `named` is the command-line flag of `path`."""
    return read_secret(path, f"{named}{path}", parse, "cloudrc key new FILE", SIZE_MAX)


def make_or_rotate(path: Path) -> KeySet:
    """Write a new key into a file; a key that the file has becomes its second one."""
    old = read_keys(path, "").current if path.exists() else None
    return _write(path, KeySet(Key(os.urandom(KEY_SIZE)), old))


def drop_previous(path: Path) -> KeySet:
    """Remove the second key from a file; raise the errors of `read_keys`."""
    return _write(path, KeySet(read_keys(path, "").current))


def _write(path: Path, keys: KeySet) -> KeySet:
    target = Path(os.path.realpath(path))  # keep a symbolic link: replace the file it points to
    write_atomically(target, write(keys).encode("ascii"), 0o600)
    return keys
