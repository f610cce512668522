"""Pre-shared keys: what is read from a key file, and which keys an end accepts now.

A key never shows itself: it has no text, cannot be pickled, and hands out only what is derived
from it. What is derived is bound to the wire's version and to its use, by HKDF-SHA256 (RFC 5869).
"""

from __future__ import annotations

import hashlib
import hmac
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
    """

    current: Key
    previous: Key | None = None
    overlap: float = OVERLAP


class KeyRing:
    """The keys that one end accepts; the driver puts new ones in while it flies.

    The overlap counts on the process's own monotonic clock from the moment it reads the file: what
    the wall clock says, here or where the file was made, does not matter.
    """

    def __init__(self, keys: KeySet, now_ns: int = 0) -> None:
        """Begin with the keys of a file that has just been read [ns, monotonic clock]."""
        self.current = keys.current
        self._previous = keys.previous
        self._until_ns = now_ns + round(keys.overlap * 1e9)

    def replace(self, keys: KeySet, now_ns: int) -> None:
        """Take what the file holds now; the key until now stays valid for the overlap."""
        previous = keys.previous
        if previous is None and keys.current != self.current:
            previous = self.current
        self.current, self._previous = keys.current, previous
        self._until_ns = now_ns + round(keys.overlap * 1e9)

    def accepted(self, now_ns: int) -> tuple[Key, ...]:
        """The keys that are valid at this moment, the one to use first."""
        if self._previous is not None and now_ns < self._until_ns:
            return self.current, self._previous
        return (self.current,)


def parse(data: bytes) -> KeySet:
    """Read a key file: 32 bytes, or lines of `current HEX`, `previous HEX`, `overlap_s SECONDS`.

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
        raise ValueError("its lines are 'current', and perhaps 'previous' and 'overlap_s'")
    previous = _key(fields["previous"]) if "previous" in fields else None
    return KeySet(_key(fields["current"]), previous, _overlap(fields.get("overlap_s")))


def write(keys: KeySet) -> str:
    """Lay out a key file."""
    lines = ["# A key of cloudrc's tunnel: keep it secret. Made by 'cloudrc key new'."]
    lines.append(f"current {keys.current.text()}")
    if keys.previous is not None:
        lines += [f"previous {keys.previous.text()}", f"overlap_s {keys.overlap:g}"]
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


_FIELDS = {"current", "previous", "overlap_s"}
