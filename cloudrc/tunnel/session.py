"""Seal outgoing datagrams and open incoming ones under the keys of one end's session.

Each direction of an epoch has one key, derived by HKDF from a pre-shared key, both ends' nonces and
the epoch. One key is enough for an epoch: 2^32 datagrams take over a year. A datagram changes no
state before its tag is verified.

Counters restart with every epoch. Greetings have no epoch yet, so they keep counting: the link
draws impairments by epoch and counter, and would lose a greeting with a repeated counter each time.

Two ends in one process need no keys: virtual time has no wire to protect, and sealing would take a
twentieth of the flight's time. Drivers with a socket refuse such a session (`Endpoint.sealed`), so
a missing key never leads to plaintext on a wire.
"""

from __future__ import annotations

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import AESGCM

from cloudrc.tunnel.codec import (
    HEADER_SIZE,
    LAST_GREETING,
    TAG_SIZE,
    DecodeError,
    Direction,
    Kind,
    check,
    encode_header,
)
from cloudrc.tunnel.keys import Key, KeyRing, KeySet

NO_EPOCH = 0
"""Epoch of an end without a session, and of every hello, challenge and refusal."""
TIMELESS = frozenset(range(1, LAST_GREETING + 1)) - {Kind.ACCEPT}
"""Kinds of datagram that belong to no epoch: all greetings except ACCEPT."""
_PUBLIC_KEY = b"nothing is secret in one process"
_NO_TAG = bytes(TAG_SIZE)


class NoCipher:
    """Replace the cipher between two ends in one process: the tag is zeros."""

    def encrypt(self, nonce: bytes, body: bytes, header: bytes) -> bytes:
        """Append zeros."""
        return body + _NO_TAG

    def decrypt(self, nonce: bytes, data: bytes, header: bytes) -> bytes:
        """Remove the zeros."""
        return data[:-TAG_SIZE]


class Session:
    """Keys and counters of one end under the current epoch.

    Attributes:
        epoch: Current epoch; `NO_EPOCH` without a session.
        sealed: Whether datagrams of the session are encrypted and authenticated.
        ring: The pre-shared keys; `follow_keys` adopts changes.
        greeting_key: Pre-shared key of the last opened greeting.
        epoch_key: Pre-shared key of the epoch.
        is_outdated: Whether the key file has a newer key than the epoch.
    """

    def __init__(self, sends: Direction, ring: KeyRing | None) -> None:
        """Start without a session; this end sends in the direction `sends`.

        `ring` holds the pre-shared keys; it is None if both ends are in one process.
        """
        self.epoch, self.sealed = NO_EPOCH, ring is not None
        self.ring = ring or KeyRing(KeySet(Key(_PUBLIC_KEY)))
        self._keys = self.ring.keys
        self.greeting_key = self.epoch_key = self._keys.current
        self.is_outdated = False
        self._sends, self._opens = int(sends), 1 - int(sends)
        self._counters = dict.fromkeys(map(int, Kind), 0)
        self._nonces = b""

    def begin(self, epoch: int, nonces: bytes = b"", key: Key | None = None) -> None:
        """Begin an epoch: derive new keys and restart the counters.

        `nonces` are cloud's nonce, then world's; `key` is the pre-shared key of the handshake.
        A value that is missing stays as in the previous epoch.
        """
        self.epoch = epoch
        self._counters |= dict.fromkeys(self._counters.keys() - TIMELESS, 0)
        self._nonces = nonces or self._nonces
        self.epoch_key = key or self.epoch_key
        self.is_outdated = self.epoch_key != self._keys.current
        self._sealing, self._opening = self._derive(self._sends), self._derive(self._opens)

    def seal(self, kind: int, body: bytes) -> bytes:
        """Seal `body` as the next datagram of this kind."""
        counters = self._counters
        counter = counters[kind]
        counters[kind] = counter + 1
        header = encode_header(kind, self._sends, self.epoch, counter)
        return header + self._sealing.encrypt(header[4:], body, header)

    def greet(self, kind: int, body: bytes, key: Key | None = None) -> bytes:
        """Make a greeting with a tag by a pre-shared key, by default the key of the epoch."""
        counter = self._counters[kind]
        self._counters[kind] = counter + 1
        epoch = NO_EPOCH if kind in TIMELESS else self.epoch
        data = encode_header(kind, self._sends, epoch, counter) + body
        return data + (key or self.epoch_key).tag(data)

    def open(self, data: bytes) -> tuple[int, int, int, bytes]:
        """Verify a datagram; return its kind, epoch and counter, and its body.

        Raises:
            DecodeError: "malformed", "version", "direction" (the direction in which this end
                sends), "old_epoch" (an epoch other than the current one) or "tag".
        """
        _, direction, epoch, kind, counter = check(data)
        if direction != self._opens:
            raise DecodeError("direction")
        self.follow_keys()
        if kind <= LAST_GREETING:
            return kind, epoch, counter, self._open_greeting(data)
        if epoch != self.epoch or not epoch:
            raise DecodeError("old_epoch")
        try:
            body = self._opening.decrypt(data[4:16], data[16:], data[:16])
        except InvalidTag:
            raise DecodeError("tag") from None
        if counter >> 63:  # a recording holds signed 64-bit integers
            raise DecodeError("malformed")
        return kind, epoch, counter, body

    def next_counter(self, kind: int) -> int:
        """Return the counter of the next datagram of this kind."""
        return self._counters[kind]

    def follow_keys(self) -> None:
        """Adopt a new key file; end the session if the file does not contain the session's key."""
        if (keys := self.ring.keys) is self._keys:
            return
        self._keys = keys
        self.is_outdated = self.epoch_key != keys.current
        if self.epoch_key not in keys.accepted:
            self.epoch = NO_EPOCH

    def _open_greeting(self, data: bytes) -> bytes:
        signed, tag = data[:-TAG_SIZE], data[-TAG_SIZE:]
        for key in self._keys.accepted:
            if key.verifies(signed, tag):
                self.greeting_key = key
                return signed[HEADER_SIZE:]
        raise DecodeError("tag")

    def _derive(self, direction: int) -> AESGCM | NoCipher:
        assert self._nonces, "the handshake comes first"
        if not self.sealed:
            return NoCipher()
        use = b"session %d %d" % (direction, self.epoch)
        return AESGCM(self.epoch_key.derive(self._nonces, use))


def pair(epoch: int = 1, secret: bytes | None = b"p" * 32) -> tuple[Session, Session]:
    """Make both ends of a session, world's first, for tests; None makes unsealed ends."""
    ring = None if secret is None else KeyRing(KeySet(Key(secret)))
    ends = Session(Direction.UPLINK, ring), Session(Direction.DOWNLINK, ring)
    for end in ends:
        end.begin(epoch, b"cloud".ljust(16) + b"world".ljust(16))
    return ends
