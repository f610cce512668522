"""Pre-shared keys: what is read from a key file, and which keys an end accepts now.

A key never shows itself: it has no text, cannot be pickled, and hands out only what is derived
from it. What is derived is bound to the wire's version and to its use, by HKDF-SHA256 (RFC 5869).
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
"""How long the key before stays valid unless the file says otherwise [s].

A Secret reaches the two pods up to two minutes apart.
"""
OVERLAP_MAX = 86_400.0
CLOCK_SLACK = 60.0
"""By which a machine's wall clock may lie behind that of the one on which a file was made [s]."""
UNTIL_MAX = 253_402_300_799.0
"""The last second of the year 9999, since 1970 [s]."""
_LABEL = b"cloudrc %d " % VERSION


class Key:
    """One pre-shared key of 32 bytes, which nobody gets to see."""

    __slots__ = ("_secret", "_tagging", "name")

    def __init__(self, secret: bytes) -> None:
        """Take the key over.

        Raises:
            ValueError: If it is not 32 bytes long; the text does not hold it.
        """
        if len(secret) != KEY_SIZE:
            raise ValueError(f"a key has {KEY_SIZE} bytes, not {len(secret)}")
        self._secret = secret
        self._tagging = self.derive(b"", b"greeting")
        self.name = self.derive(b"", b"name")[:4].hex()  # tells two keys apart, and nothing else

    def derive(self, salt: bytes, use: bytes) -> bytes:
        """Derive 32 bytes for one use."""
        return HKDF(SHA256(), KEY_SIZE, salt, _LABEL + use).derive(self._secret)

    def tag(self, data: bytes) -> bytes:
        """Authenticate a datagram that belongs to no session: HMAC-SHA256, cut to 16 bytes."""
        return hmac.digest(self._tagging, data, hashlib.sha256)[:TAG_SIZE]

    def verifies(self, data: bytes, tag: bytes) -> bool:
        """Check a tag, in constant time."""
        return hmac.compare_digest(self.tag(data), tag)

    def text(self) -> str:
        """The key as a key file has it: for writing such a file, and nothing else."""
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
    """What a key file holds.

    Attributes:
        current: The key to use.
        previous: One that is still accepted; None if there is none.
        overlap: For how long, from the moment a process reads this [s].
        until: When it ends for processes that start later [s], wall clock, since 1970; None if the
            file does not say.
    """

    current: Key
    previous: Key | None = None
    overlap: float = OVERLAP
    until: float | None = None

    def rotated(self, secret: bytes, wall: float, overlap: float = OVERLAP) -> KeySet:
        """Put a new key in front of the current one.

        Args:
            secret: The new key, 32 bytes that nobody can guess.
            wall: What the wall clock says [s since 1970].
            overlap: For how long the current one stays valid [s].
        """
        return KeySet(Key(secret), self.current, overlap, float(math.ceil(wall + overlap)))

    def left(self, wall: float | None) -> float:
        """For how long a process that starts now accepts the previous key [s]; 0 for not at all.

        Args:
            wall: What its wall clock says [s since 1970]; None if it has none to go by.
        """
        if self.until is None or wall is None:
            return self.overlap
        left = self.until - wall
        # A clock that shows a time before the file was made does not know how old the file is.
        return 0.0 if left > self.overlap + CLOCK_SLACK else min(max(left, 0.0), self.overlap)

    def caution(self, wall: float) -> str:
        """What a process that starts has to tell about the previous key; "" for nothing.

        Args:
            wall: What its wall clock says [s since 1970].
        """
        if self.previous is None or (self.until is not None and self.left(wall) > 0.0):
            return ""
        name, advice = self.previous.name, "drop it: cloudrc key retire FILE"
        if self.until is None:
            return (
                f"key {name}, the one before, is accepted for {self.overlap:g} s from every start "
                f"on, for the key file does not say until when; {advice}"
            )
        if self.until > wall:
            return (
                f"key {name}, the one before, is refused: by this machine's clock "
                f"({_date(wall)}) the key file is not made yet; set the clock"
            )
        return f"key {name}, the one before, is refused: valid until {_date(self.until)}; {advice}"


class KeyRing:
    """The keys that one end accepts; the driver puts new ones in while it flies.

    The overlap counts on the process's own monotonic clock from the moment it reads the file. A
    process that starts cannot know how long the file has been there: it accepts the key before only
    as long as the file says, by the wall clock, which is asked this once. In flight none is.

    Attributes:
        current: The key to use.
        version: Rises whenever new ones are put in.
    """

    def __init__(self, keys: KeySet, now_ns: int = 0, wall: float | None = None) -> None:
        """Begin with the keys of a file.

        Args:
            keys: Just read.
            now_ns: Monotonic clock [ns].
            wall: What the wall clock says [s since 1970]; None to count the overlap from now.
        """
        self.current = keys.current
        self.version = 0
        self._previous = keys.previous
        self._until_ns = now_ns + round(keys.left(wall) * 1e9)

    def replace(self, keys: KeySet, now_ns: int) -> None:
        """Take what the file holds now; the key until now stays valid for the overlap.

        The time of a previous key that is known as such already only becomes shorter, whatever is
        written beside it.
        """
        previous, until_ns = keys.previous, now_ns + round(keys.overlap * 1e9)
        if previous is None and keys.current != self.current:
            previous = self.current
        if previous == self._previous:
            until_ns = min(until_ns, self._until_ns)
        self.current, self._previous, self._until_ns = keys.current, previous, until_ns
        self.version += 1

    def accepted(self, now_ns: int) -> tuple[Key, ...]:
        """The keys that are valid at this moment, the one to use first."""
        if self._previous is not None and now_ns < self._until_ns:
            return self.current, self._previous
        return (self.current,)


def parse(data: bytes) -> KeySet:
    """Read a key file: 32 bytes, or lines of a name and a value.

    These are `current HEX`, and perhaps `previous HEX`, `overlap_s SECONDS` and
    `previous_until_s SECONDS`, since 1970.

    Raises:
        ValueError: What is wrong with it, in words that hold nothing of it.
    """
    if len(data) == KEY_SIZE:
        return KeySet(Key(data))
    try:
        lines = [line.split() for line in data.decode("ascii").splitlines()]
        words = [line for line in lines if line and not line[0].startswith("#")]
        fields = {name: value for name, value in words}
    except ValueError:
        raise ValueError(f"neither {KEY_SIZE} bytes nor lines of 'name value'") from None
    if "current" not in fields or len(fields) != len(words) or fields.keys() - _FIELDS:
        raise ValueError(f"its lines are 'current', and perhaps {_OTHERS}")
    previous = _key(fields["previous"]) if "previous" in fields else None
    overlap, until = _overlap(fields.get("overlap_s")), _until(fields.get("previous_until_s"))
    return KeySet(_key(fields["current"]), previous, overlap, until)


def write(keys: KeySet) -> str:
    """Lay out a key file."""
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
        raise ValueError(f"a key is {2 * KEY_SIZE} hexadecimal digits") from None


def _overlap(text: str | None) -> float:
    try:
        overlap = OVERLAP if text is None else float(text)
    except ValueError:
        overlap = -1.0
    if not 0 < overlap <= OVERLAP_MAX:
        raise ValueError(f"overlap_s is above 0 and at most {OVERLAP_MAX:g} [s]")
    return overlap


def _until(text: str | None) -> float | None:
    try:
        until = None if text is None else float(text)
    except ValueError:
        until = -1.0
    if until is not None and not 0 <= until <= UNTIL_MAX:
        raise ValueError("previous_until_s is seconds since 1970, before the year 10000")
    return until


def _date(wall: float) -> str:
    """Write an instant [s since 1970] down."""
    return datetime.fromtimestamp(wall, UTC).isoformat(timespec="seconds")


_FIELDS = {"current", "previous", "overlap_s", "previous_until_s"}
_OTHERS = "'previous', 'overlap_s' and 'previous_until_s'"
