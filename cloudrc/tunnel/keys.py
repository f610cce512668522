"""Read and write key files, and decide which pre-shared keys an end accepts.

A key never prints itself and cannot be pickled. The tunnel uses keys derived from it by HKDF-SHA256
(RFC 5869); each is bound to the wire version and to one use.
"""

from __future__ import annotations

import hashlib
import hmac
import math
from datetime import UTC, datetime
from typing import NamedTuple, NoReturn

from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.kdf.hkdf import HKDF

from cloudrc.tunnel.codec import TAG_SIZE, VERSION

KEY_SIZE = 32
OVERLAP = 300.0
"""Default time for which the previous key stays valid [s].

A Secret reaches the two pods up to two minutes apart.
"""
OVERLAP_MAX = 86_400.0
"""Longest overlap that a key file may ask for [s]."""
CLOCK_SLACK = 60.0
"""Largest accepted lag of this wall clock behind that of the machine that wrote the file [s]."""
UNTIL_MAX = 253_402_300_799.0
"""Last second of the year 9999 [s since 1970]."""
_LABEL = b"cloudrc %d " % VERSION


class Key:
    """A secret pre-shared key of 32 bytes.

    Attributes:
        name: Short public name that tells two keys apart.
    """

    __slots__ = ("_secret", "_tag_key", "name")

    def __init__(self, secret: bytes) -> None:
        """Make a key from its bytes.

        Raises:
            ValueError: If it is not 32 bytes long; the message does not contain it.
        """
        if len(secret) != KEY_SIZE:
            raise ValueError(f"a key has {KEY_SIZE} bytes, not {len(secret)}")
        self._secret = secret
        self._tag_key = self.derive(b"", b"greeting")
        self.name = self.derive(b"", b"name")[:4].hex()

    def derive(self, salt: bytes, use: bytes) -> bytes:
        """Derive 32 bytes for one use."""
        return HKDF(SHA256(), KEY_SIZE, salt, _LABEL + use).derive(self._secret)

    def tag(self, data: bytes) -> bytes:
        """Compute the tag of a greeting: HMAC-SHA256, cut to 16 bytes."""
        return hmac.digest(self._tag_key, data, hashlib.sha256)[:TAG_SIZE]

    def verifies(self, data: bytes, tag: bytes) -> bool:
        """Check the tag of a greeting in constant time."""
        return hmac.compare_digest(self.tag(data), tag)

    def text(self) -> str:
        """Return the secret as hexadecimal text; use it only to write a key file."""
        return self._secret.hex()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Key) and hmac.compare_digest(self._secret, other._secret)

    def __hash__(self) -> int:
        return hash(self.name)

    def __repr__(self) -> str:
        return f"<key {self.name}>"

    def __reduce__(self) -> NoReturn:
        raise TypeError("a key is not pickled")


class KeySet(NamedTuple):
    """The content of a key file.

    Attributes:
        current: The key to use.
        previous: The key before it, accepted for a while; None if there is none.
        overlap: How long a process accepts it after reading the file [s].
        until: When it expires for processes that start later [s since 1970], by the wall clock;
            None if the file does not say.
    """

    current: Key
    previous: Key | None = None
    overlap: float = OVERLAP
    until: float | None = None

    def rotated(self, secret: bytes, wall: float, overlap: float = OVERLAP) -> KeySet:
        """Make a key set in which a new key replaces the current one.

        Args:
            secret: The new key, 32 random bytes.
            wall: Wall clock [s since 1970].
            overlap: How long the current key stays valid [s].
        """
        return KeySet(Key(secret), self.current, overlap, float(math.ceil(wall + overlap)))

    def left(self, wall: float | None) -> float:
        """Return how long a process that starts now accepts the previous key [s].

        Args:
            wall: Wall clock of the process [s since 1970]; None to use the whole overlap.
        """
        if self.until is None or wall is None:
            return self.overlap
        left = self.until - wall
        # A clock that shows a time before the file was written cannot tell the file's age.
        return 0.0 if left > self.overlap + CLOCK_SLACK else min(max(left, 0.0), self.overlap)

    def warning(self, wall: float) -> str:
        """Return a warning about the previous key for a process that starts; "" if none is needed.

        Args:
            wall: Wall clock of the process [s since 1970].
        """
        if self.previous is None or (self.until is not None and self.left(wall) > 0.0):
            return ""
        name, advice = self.previous.name, "drop it: cloudrc key retire FILE"
        if self.until is None:
            return (
                f"the previous key {name} is accepted for {self.overlap:g} s after every start, "
                f"because the key file has no expiry time; {advice}"
            )
        if self.until > wall:
            return (
                f"the previous key {name} is refused: this machine's clock ({_date(wall)}) is "
                "behind the time when the key file was written; set the clock"
            )
        return f"the previous key {name} is refused: valid until {_date(self.until)}; {advice}"


class KeyRing:
    """The keys that one end accepts; the driver replaces them in flight.

    The overlap runs on the process's own monotonic clock from the moment it reads the file. The
    wall clock is read only at the start of the process, to find out how old the file is.

    Attributes:
        current: The key to use.
        version: Rises with every replacement of the keys.
    """

    def __init__(self, keys: KeySet, now_ns: int = 0, wall: float | None = None) -> None:
        """Begin with the keys of a file.

        Args:
            keys: Content of the file that was just read.
            now_ns: Monotonic clock [ns].
            wall: Wall clock [s since 1970]; None to count the overlap from now.
        """
        self.current = keys.current
        self.version = 0
        self._previous = keys.previous
        self._until_ns = now_ns + round(keys.left(wall) * 1e9)

    def replace(self, keys: KeySet, now_ns: int) -> None:
        """Replace the keys; the key used until now stays valid for the overlap.

        If `keys` names the same previous key as before, the end of that key's validity can move
        earlier, never later.
        """
        previous, until_ns = keys.previous, now_ns + round(keys.overlap * 1e9)
        if previous is None and keys.current != self.current:
            previous = self.current
        if previous == self._previous:
            until_ns = min(until_ns, self._until_ns)
        self.current, self._previous, self._until_ns = keys.current, previous, until_ns
        self.version += 1

    def accepted(self, now_ns: int) -> tuple[Key, ...]:
        """Return the keys that are valid now, the current key first."""
        if self._previous is not None and now_ns < self._until_ns:
            return self.current, self._previous
        return (self.current,)


def parse(data: bytes) -> KeySet:
    """Parse a key file: 32 bytes, or lines of a name and a value.

    The lines are `current HEX` and optionally `previous HEX`, `overlap_s SECONDS` and
    `previous_until_s SECONDS` (since 1970).

    Raises:
        ValueError: If the file is invalid; the message contains nothing of the file.
    """
    if len(data) == KEY_SIZE:
        return KeySet(Key(data))
    try:
        lines = [line.split() for line in data.decode("ascii").splitlines()]
        pairs = [line for line in lines if line and not line[0].startswith("#")]
        fields = {name: value for name, value in pairs}
    except ValueError:
        raise ValueError(f"neither {KEY_SIZE} bytes nor lines of 'name value'") from None
    if "current" not in fields or len(fields) != len(pairs) or fields.keys() - _FIELDS:
        raise ValueError(f"expected the line 'current' and optionally {_OPTIONAL}, each once")
    previous = _key(fields["previous"]) if "previous" in fields else None
    overlap, until = _overlap(fields.get("overlap_s")), _until(fields.get("previous_until_s"))
    return KeySet(_key(fields["current"]), previous, overlap, until)


def write(keys: KeySet) -> str:
    """Write the text of a key file."""
    lines = ["# A key of cloudrc's tunnel: keep it secret. Made by 'cloudrc key new'."]
    lines.append(f"current {keys.current.text()}")
    if keys.previous is not None:
        lines += [f"previous {keys.previous.text()}", f"overlap_s {keys.overlap:g}"]
        if keys.until is not None:
            lines.append(f"previous_until_s {keys.until:.0f}")
    return "\n".join(lines) + "\n"


def _key(text: str) -> Key:
    try:
        return Key(bytes.fromhex(text))
    except ValueError:
        raise ValueError(f"a key has {2 * KEY_SIZE} hexadecimal digits") from None


def _overlap(text: str | None) -> float:
    try:
        overlap = OVERLAP if text is None else float(text)
    except ValueError:
        overlap = -1.0
    if not 0 < overlap <= OVERLAP_MAX:
        raise ValueError(f"overlap_s must be above 0 and at most {OVERLAP_MAX:g} [s]")
    return overlap


def _until(text: str | None) -> float | None:
    try:
        until = None if text is None else float(text)
    except ValueError:
        until = -1.0
    if until is not None and not 0 <= until <= UNTIL_MAX:
        raise ValueError("previous_until_s must be seconds since 1970, before the year 10000")
    return until


def _date(wall: float) -> str:
    """Format an instant [s since 1970] as ISO 8601."""
    return datetime.fromtimestamp(wall, UTC).isoformat(timespec="seconds")


_FIELDS = {"current", "previous", "overlap_s", "previous_until_s"}
_OPTIONAL = "'previous', 'overlap_s' and 'previous_until_s'"
