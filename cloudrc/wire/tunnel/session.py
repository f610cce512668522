# SPDX-License-Identifier: Apache-2.0

"""Encrypt outgoing datagrams and verify incoming datagrams with the keys of a session.

A datagram changes no state before its tag is verified. Counters restart with every session, except
those of HELLO, CHALLENGE and BUSY: the emulated link decides by epoch and counter which datagrams
it loses. With restarted counters, it would lose the same handshake datagrams in every attempt.
"""

from __future__ import annotations

from typing import Any

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import AESGCM

from cloudrc.wire.messages import Datagram, Passed
from cloudrc.wire.tunnel.codec import (
    COMMAND_SIZES,
    HEADER_SIZE,
    LAST_HANDSHAKE,
    SCAN_SIZES,
    SIZES,
    TAG_SIZE,
    TELEMETRY_SIZES,
    DecodeError,
    Direction,
    Kind,
    check,
    encode_header,
)
from cloudrc.wire.tunnel.keys import Key, KeyRing

COMMAND, SCAN, FRAME = int(Kind.COMMAND), int(Kind.SCAN), int(Kind.FRAME)  # often looked up
NO_EPOCH = 0  # epoch of an end without a session, and of every HELLO, CHALLENGE and BUSY datagram
TIMELESS = frozenset(range(1, LAST_HANDSHAKE + 1)) - {Kind.ACCEPT}  # kinds without a session
_new = tuple.__new__  # makes a named tuple twice as fast as its class does


class Session:
    """Keys and counters of world or cloud in the present session.

    `epoch` is the number of the session, or `NO_EPOCH`. `epoch_key` is the pre-shared key of the
    session; `is_outdated` tells whether the key file has a newer key. `handshake_key` is the
    pre-shared key that verified the last handshake datagram.
    """

    def __init__(self, sends: Direction, ring: KeyRing) -> None:
        """Set the direction in which this endpoint sends, and `ring`, the pre-shared keys."""
        self.epoch, self.ring, self._keys = NO_EPOCH, ring, ring.keys
        self.handshake_key = self.epoch_key = self._keys.current
        self.is_outdated = False
        self._sends, self._opens = int(sends), 1 - int(sends)
        self._counters = dict.fromkeys(map(int, Kind), 0)
        self._nonces = b""

    def begin(self, epoch: int, nonces: bytes = b"", key: Key | None = None) -> None:
        """Begin a session with the number `epoch`: derive its keys and restart its counters.

        `nonces` is cloud's nonce followed by world's nonce; `key` is the pre-shared key of the
        handshake. The default of both is the value of the previous session.
        """
        self.epoch = epoch
        self._counters |= dict.fromkeys(self._counters.keys() - TIMELESS, 0)
        self._nonces = nonces or self._nonces
        self.epoch_key = key or self.epoch_key
        self.is_outdated = self.epoch_key != self._keys.current
        self._sealing, self._opening = self._derive(self._sends), self._derive(self._opens)

    def seal(self, kind: int, body: bytes) -> bytes:
        """Encrypt `body` as the next datagram of this kind; return the datagram."""
        counters = self._counters
        counter = counters[kind]
        counters[kind] = counter + 1
        header = encode_header(kind, self._sends, self.epoch, counter)
        return header + self._sealing.encrypt(header[4:], body, header)

    def pass_on(self, kind: int, message: Any) -> Passed:
        """Give a message of a session the counter of its next datagram, without encryption.

        Use this method in place of `seal` only if the receiver is in the same process: the result
        is a Python object, not bytes.
        """
        counters = self._counters
        counter = counters[kind]
        counters[kind] = counter + 1
        if kind == COMMAND:
            size = COMMAND_SIZES[len(message.plan)]
        elif kind == SCAN:
            size = SCAN_SIZES[len(message.millimetres)]
        elif kind == FRAME:
            size = SIZES[FRAME] + len(message.data)
        else:
            size = TELEMETRY_SIZES[len(message.sensors)]
        return _new(Passed, (kind, self.epoch, counter, message, size))

    def sign(self, kind: int, body: bytes, key: Key | None = None) -> bytes:
        """Make a handshake datagram with a tag made with `key`, by default the session's key."""
        counter = self._counters[kind]
        self._counters[kind] = counter + 1
        epoch = NO_EPOCH if kind in TIMELESS else self.epoch
        data = encode_header(kind, self._sends, epoch, counter) + body
        return data + (key or self.epoch_key).tag(data)

    def open(self, data: Datagram) -> tuple[int, int, int, Any]:
        """Verify a datagram; return its kind, epoch, counter and decrypted body.

        If `pass_on` made the datagram, it is not encrypted, and the body is the message itself.

        Raises:
            DecodeError: "malformed"; "version"; "direction" if this endpoint itself sends in the
                datagram's direction; "old_epoch" for another session; "tag" for a wrong tag.
        """
        if type(data) is Passed:
            if data[1] != self.epoch or not data[1]:
                raise DecodeError("old_epoch")
            return data[:4]
        _, direction, epoch, kind, counter = check(data)
        if direction != self._opens:
            raise DecodeError("direction")
        self.follow_keys()
        if kind <= LAST_HANDSHAKE:
            return kind, epoch, counter, self._open_handshake(data)
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
        """Return the counter that the next datagram of a kind will have."""
        return self._counters[kind]

    def follow_keys(self) -> None:
        """Adopt a changed key file; end the session if the file no longer has the session's key."""
        if (keys := self.ring.keys) is self._keys:
            return
        self._keys = keys
        self.is_outdated = self.epoch_key != keys.current
        if self.epoch_key not in keys.accepted:
            self.epoch = NO_EPOCH

    def _open_handshake(self, data: bytes) -> bytes:
        signed, tag = data[:-TAG_SIZE], data[-TAG_SIZE:]
        for key in self._keys.accepted:
            if key.verifies(signed, tag):
                self.handshake_key = key
                return signed[HEADER_SIZE:]
        raise DecodeError("tag")

    def _derive(self, direction: int) -> AESGCM:
        assert self._nonces, "the handshake comes first"
        use = b"session %d %d" % (direction, self.epoch)
        return AESGCM(self.epoch_key.derive(self._nonces, use))
