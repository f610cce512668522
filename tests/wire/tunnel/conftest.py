# SPDX-License-Identifier: Apache-2.0

"""A world that answers hellos, for the tests of the handshake."""

from cloudrc.wire.tunnel.codec import Direction, Hello, Kind, decode
from cloudrc.wire.tunnel.handshake import CHALLENGE_NS, COOKIE_NS, NO_COOKIE, ServerHandshake
from cloudrc.wire.tunnel.keys import Key, KeyRing, KeySet
from cloudrc.wire.tunnel.session import NO_EPOCH, Session

MS = 1_000_000
SECOND_NS = 1000 * MS
KEY = Key(b"k" * 32)
NEW = Key(b"n" * 32)
NONCE, CLOCK, WORLD = b"n" * 16, b"c" * 16, b"w" * 16
OTHER = b"m" * 16
"""Nonce of another cloud."""


def pair(epoch=1, secret=b"p" * 32):
    """Make world's and cloud's end of a session."""
    ring = KeyRing(KeySet(Key(secret)))
    ends = Session(Direction.UPLINK, ring), Session(Direction.DOWNLINK, ring)
    for end in ends:
        end.begin(epoch, b"cloud".ljust(16) + b"world".ljust(16))
    return ends


class Doorstep:
    """World's side of the handshake, with a cloud that sends hellos."""

    def __init__(self):
        self.world = Session(Direction.UPLINK, KeyRing(KeySet(KEY)))
        self.cloud = Session(Direction.DOWNLINK, self.world.ring)
        self.door = ServerHandshake(self.world, WORLD, CLOCK, 250 * MS)
        self.now_ns = 10 * COOKIE_NS
        self.counter = 0

    def receive_hello(self, nonce=NONCE, cookie=None, counter=None, key=None, epoch=NO_EPOCH):
        """Send a hello, by default with a valid cookie, the next counter and the newest key."""
        self.counter += 1
        counter = self.counter if counter is None else counter
        cookie = self.door._cookie(self.now_ns) if cookie is None else cookie
        self.world.follow_keys()
        self.world.handshake_key = key or self.world.ring.keys.current
        return self.door.receive_hello(Hello(nonce, CLOCK, cookie, epoch), counter, self.now_ns)

    def answer(self, *given, **named):
        """Return kind, epoch and body of the answer to a hello."""
        (data,) = self.receive_hello(*given, **named).datagrams
        kind, epoch, _, body = self.cloud.open(data)
        return kind, epoch, body

    def cookie(self):
        """Return the cookie of a challenge; first wait until world may send a challenge."""
        self.now_ns = max(self.now_ns, self.door._challenged_ns + CHALLENGE_NS)
        kind, _, body = self.answer(cookie=NO_COOKIE)
        assert kind == Kind.CHALLENGE
        return decode(Kind.CHALLENGE, body)[0]
