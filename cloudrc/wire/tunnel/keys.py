# SPDX-License-Identifier: Apache-2.0

"""Pre-shared keys, the keys that HKDF-SHA256 (RFC 5869) derives from them, and the key file."""

from __future__ import annotations

import hashlib
import hmac
from dataclasses import dataclass, field
from typing import NamedTuple

from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.kdf.hkdf import HKDF

from cloudrc.wire.tunnel.codec import TAG_SIZE, VERSION

KEY_SIZE = 32  # size of a pre-shared key and of a derived key [bytes]
_LABEL = b"cloudrc %d " % VERSION


@dataclass(frozen=True, repr=False, slots=True)
class Key:
    """A secret pre-shared key of 32 bytes. `repr` and messages of errors do not show the secret.

    Raises:
        ValueError: If the secret is not 32 bytes long, or if all bytes are zero.
    """

    _secret: bytes
    _tag_key: bytes = field(init=False, compare=False)
    name: str = field(init=False, compare=False)  # short and public, to tell keys apart in logs

    def __post_init__(self) -> None:
        if len(self._secret) != KEY_SIZE:
            raise ValueError(f"a key has {KEY_SIZE} bytes, not {len(self._secret)}")
        if not any(self._secret):
            raise ValueError("an all-zero key is refused: everybody knows it")
        object.__setattr__(self, "_tag_key", self.derive(b"", b"greeting"))
        object.__setattr__(self, "name", self.derive(b"", b"name")[:4].hex())

    def derive(self, salt: bytes, use: bytes) -> bytes:
        """Derive a key of 32 bytes from this key and `salt`; `use` is the new key's purpose."""
        return HKDF(SHA256(), KEY_SIZE, salt, _LABEL + use).derive(self._secret)

    def tag(self, data: bytes) -> bytes:
        """Compute the authentication tag of a handshake datagram: HMAC-SHA256, cut to 16 bytes."""
        return hmac.digest(self._tag_key, data, hashlib.sha256)[:TAG_SIZE]

    def verifies(self, data: bytes, tag: bytes) -> bool:
        """Return whether `tag` is the tag of `data`; the comparison takes constant time."""
        return hmac.compare_digest(self.tag(data), tag)

    def text(self) -> str:
        """Return the secret as hexadecimal text; use it only to write a key file."""
        return self._secret.hex()

    def __repr__(self) -> str:
        return f"<key {self.name}>"


class KeySet(NamedTuple):
    """The keys in a key file: the current key and, during a rotation, the previous key."""

    current: Key
    previous: Key | None = None

    @property
    def accepted(self) -> tuple[Key, ...]:
        """The keys that an endpoint accepts in a handshake; the first is the current key."""
        return (self.current,) if self.previous is None else (self.current, self.previous)


@dataclass
class KeyRing:
    """The keys of world or cloud; the driver replaces `keys` if the key file changes."""

    keys: KeySet


def parse(data: bytes) -> KeySet:
    """Parse a key file: 32 bytes, or the lines `current HEX` and optionally `previous HEX`.

    Raise a ValueError if the file is invalid. The message contains no part of the file.
    """
    if len(data) == KEY_SIZE:
        return KeySet(Key(data))
    try:
        lines = [line.split() for line in data.decode("ascii").splitlines()]
        pairs = [line for line in lines if line and not line[0].startswith("#")]
        fields = {name: value for name, value in pairs}
    except ValueError:
        raise ValueError(f"neither {KEY_SIZE} bytes nor lines of 'name value'") from None
    if "current" not in fields or len(fields) != len(pairs) or fields.keys() - {*KeySet._fields}:
        raise ValueError("expected the line 'current' and optionally 'previous', each once")
    return KeySet(**{name: _key(text) for name, text in fields.items()})


def write(keys: KeySet) -> str:
    """Return the text of a key file."""
    lines = ["# A key of cloudrc's tunnel: keep it secret. Made by 'cloudrc key new'."]
    lines += [f"{name} {key.text()}" for name, key in keys._asdict().items() if key is not None]
    return "\n".join(lines) + "\n"


def _key(text: str) -> Key:
    try:
        secret = bytes.fromhex(text)
    except ValueError:
        secret = b""
    if len(secret) != KEY_SIZE:
        raise ValueError(f"a key has {2 * KEY_SIZE} hexadecimal digits")
    return Key(secret)
