"""A session without keys, for two ends in one process: virtual time has no wire to protect.

Sealing two datagrams takes some 4 us per 10 ms of flight, a twentieth of what a virtual flight
takes at all. An end has such a session if it was given no keys; a driver with a socket refuses it
(`Endpoint.sealed`), so forgetting the key is an error at the start and never plaintext on a wire.
"""

from __future__ import annotations

from cloudrc.tunnel.codec import (
    HEADER_SIZE,
    LAST_GREETING,
    TAG_SIZE,
    Datagram,
    DecodeError,
    Direction,
    check,
    encode_header,
)
from cloudrc.tunnel.keys import Key, KeyRing, KeySet
from cloudrc.tunnel.session import Session

NO_SECRET = KeySet(Key(bytes(32)))
"""What the greetings within one process are authenticated with."""
NO_TAG = bytes(TAG_SIZE)


class UnsealedSession(Session):
    """A session whose datagrams are as long as sealed ones; nothing but their tag is missing."""

    sealed = False

    def __init__(self, sends: Direction) -> None:
        """Start without a session."""
        super().__init__(sends, KeyRing(NO_SECRET))

    def seal(self, kind: int, body: bytes) -> bytes:
        """Make the datagram of the session that carries `body`."""
        counter = self._counters[kind]
        self._counters[kind] = counter + 1
        return encode_header(kind, self._sends, self.epoch, counter) + body + NO_TAG

    def open(self, data: bytes) -> Datagram:
        """Check a datagram and take it apart.

        Raises:
            DecodeError: As `Session.open`; "tag" for greetings only.
        """
        _, direction, epoch, _, kind, counter = check(data)
        if direction != self._opens:
            raise DecodeError("direction")
        if kind <= LAST_GREETING:
            return kind, direction, epoch, counter, self._open_greeting(data)
        if epoch != self.epoch or not epoch:
            raise DecodeError("old_epoch")
        return kind, direction, epoch, counter, data[HEADER_SIZE:-TAG_SIZE]

    def tend(self, now_ns: int) -> list[bytes]:
        """There is nothing to do."""
        return []


def make_session(sends: Direction, ring: KeyRing | None, now_ns: int = 0) -> Session:
    """Make an end's session: sealed if it has keys, else one that must stay in its process."""
    return UnsealedSession(sends) if ring is None else Session(sends, ring, now_ns)
