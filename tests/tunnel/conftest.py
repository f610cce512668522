"""Share a world that answers hellos between the tests of the handshake."""

from types import SimpleNamespace

from cloudrc.tunnel.codec import Direction, Hello, Kind, decode_challenge
from cloudrc.tunnel.handshake import CHALLENGE_NS, COOKIE_NS, NO_COOKIE, ServerHandshake
from cloudrc.tunnel.keys import Key, KeyRing, KeySet
from cloudrc.tunnel.session import AES_256_GCM, Session

MS = 1_000_000
SECOND_NS = 1000 * MS
KEY = Key(b"k" * 32)
NONCE, CLOCK, WORLD = b"n" * 16, b"c" * 16, b"w" * 16


class Doorstep:
    """World's side of the handshake, with a cloud that sends hellos."""

    def __init__(self, nonce=WORLD, suite=AES_256_GCM, **options):
        ring = KeyRing(KeySet(KEY))
        self.world = Session(Direction.UPLINK, ring)
        self.cloud = Session(Direction.DOWNLINK, ring)
        identity = SimpleNamespace(
            nonce=nonce, clock_id=CLOCK, suite=suite, last_epoch=options.get("last_epoch", 0),
            next_epoch=options.get("next_epoch"),
        )  # fmt: skip
        self.door = ServerHandshake(self.world, identity, age_max_ns=250 * MS)
        self.now_ns = 10 * COOKIE_NS
        self.counter = 0

    def receive_hello(
        self, nonce=NONCE, cookie=NO_COOKIE, clock=CLOCK, suite=AES_256_GCM, counter=None
    ):  # fmt: skip
        """Send a hello with this counter, or the next one."""
        self.counter += 1
        counter = self.counter if counter is None else counter
        return self.door.receive_hello(Hello(nonce, clock, cookie, suite), counter, self.now_ns)

    def answer(self, *given, **named):
        """Return kind, epoch and body of the answer to a hello."""
        (data,) = self.receive_hello(*given, **named).datagrams
        kind, _, epoch, _, body = self.cloud.open(data)
        return kind, epoch, body

    def cookie(self, nonce=NONCE):
        """Return the cookie of a challenge, as soon as world may send one."""
        self.now_ns = max(self.now_ns, self.door._challenged_ns + CHALLENGE_NS)
        kind, _, body = self.answer(nonce)
        assert kind == Kind.CHALLENGE
        return decode_challenge(body)
