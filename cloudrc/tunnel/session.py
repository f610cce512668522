"""One end's session: datagrams of its epoch are sealed on the way out and opened on the way in.

The seam for authentication: `seal` and `open` are the only way to the wire, so that keys, tags and
nonces have one place to live. Counters run per kind, so that probes and handshakes never shift
those of telemetry and commands; they start again with every epoch, but for hellos, which belong to
none: a link decides by the counter, and a repeated one would meet the same fate for ever.
"""

from __future__ import annotations

from cloudrc.tunnel.codec import (
    Datagram,
    DecodeError,
    Direction,
    Kind,
    decode,
    encode_header,
)

HELLO = int(Kind.HELLO)  # an enum's member is slow to look up
NO_EPOCH = 0
"""The epoch of an end that has no session, and of every hello."""


class Session:
    """What one end needs to talk under one epoch."""

    def __init__(self, sends: Direction) -> None:
        """Start without a session.

        Args:
            sends: The direction that this end sends in; it opens only the other one's datagrams.
        """
        self.epoch = NO_EPOCH
        self._sends = int(sends)
        self._counters = dict.fromkeys(map(int, Kind), 0)

    def begin(self, epoch: int) -> None:
        """Begin a new epoch: all counters but that of hellos start again."""
        self.epoch = epoch
        hellos = self._counters[HELLO]
        self._counters = dict.fromkeys(self._counters, 0) | {HELLO: hellos}

    def seal(self, kind: int, body: bytes) -> bytes:
        """Make the datagram that carries `body`."""
        counter = self._counters[kind]
        self._counters[kind] = counter + 1
        epoch = NO_EPOCH if kind == HELLO else self.epoch
        return encode_header(kind, self._sends, epoch, counter) + body

    def open(self, data: bytes) -> Datagram:
        """Check a datagram and take it apart; nothing changes, whatever it is.

        Raises:
            DecodeError: "malformed", "version", or "direction" for one of our own direction.
        """
        datagram = decode(data)
        if datagram[1] == self._sends:
            raise DecodeError("direction")
        return datagram

    def next_counter(self, kind: int) -> int:
        """The counter that the next datagram of this kind will carry."""
        return self._counters[kind]
