"""The handshake of a session: world's side, cloud's side, and the log of why it fails.

    cloud                                      world
      HELLO (nonce, clock, no cookie)   -->
                                        <--    CHALLENGE (cookie)
      HELLO (nonce, clock, cookie)      -->
                                        <--    ACCEPT (nonce, world's nonce, clock), a new epoch
                                            or BUSY (nonce)

Every greeting has a tag by a pre-shared key; world authenticates its answer with the key of the
hello. No answer is longer than its hello. The cookie is a MAC over a time slot, so world stores
nothing for a hello without a cookie, and a captured hello is useless after two slots. A hello with
a cookie is answered once per counter. World sends at most ten challenges per second, which name no
receiver: the true cloud can use those that somebody else has provoked.

The cloud with the session keeps it while world hears this cloud: at least one new sealed datagram
per `command_age_max`. Otherwise another cloud can get a session under the next epoch. Epochs rise
even if world restarts, because each hello contains the newest epoch of its cloud.

Deviation: WireGuard also derives session keys by Diffie-Hellman. In this tunnel the pre-shared key
is enough: one owner has both ends, and anybody with the key can command the robot anyway.
"""

from __future__ import annotations

import hashlib
import hmac
from collections import deque
from typing import NamedTuple

from cloudrc.records import Fault
from cloudrc.tunnel import codec
from cloudrc.tunnel.channel import REPEATED, Channel
from cloudrc.tunnel.codec import Accept, DecodeError, Hello, Kind
from cloudrc.tunnel.session import NO_EPOCH, Session

EPOCH_MAX = 2**32 - 1
"""Last epoch that the header can hold; the next epoch is 1."""
CHALLENGE_NS = 100_000_000
"""Shortest time between two challenges [ns]."""
COOKIE_NS = 2_000_000_000
"""Length of a cookie's time slot [ns]; a cookie is valid in its slot and in the next slot."""
GRACE_NS = 1_000_000_000
"""Time for which a cloud keeps a new session although world has not heard that cloud yet [ns]."""
REPEATS_MAX = 3
"""How often world repeats its acceptance to a cloud that world does not hear."""
CLOUDS_MAX = 64
"""Number of nonces of which world remembers the newest counter."""
NO_COOKIE = bytes(codec.COOKIE_SIZE)
"""Cookie of the first hello."""
REPLIES_MAX = 3
"""Largest number of challenges that cloud answers between two periodic hellos."""
COOKIES_MAX = 4096
"""Number of cookies that cloud remembers, one per time slot, for more than two hours in total."""
WORLDS_MAX = 64
"""Number of earlier world processes that cloud remembers."""


def is_newer(epoch: int, than: int) -> bool:
    """Return whether `epoch` is ahead of `than` by less than half of all epochs."""
    return 0 < (epoch - than) % (EPOCH_MAX + 1) <= EPOCH_MAX // 2


class HelloAnswer(NamedTuple):
    """World's answer to a hello: name of its count, datagrams, and whether it opened a session."""

    outcome: str
    datagrams: list[bytes]
    opened: bool = False


class ServerHandshake:
    """World's side of the handshake: decide which cloud has authority, and under which epoch."""

    def __init__(self, session: Session, nonce: bytes, clock: bytes, age_max_ns: int) -> None:
        """Begin without a session.

        Args:
            session: World's session; this class begins the epochs of the session.
            nonce: 16 bytes that identify this process, new at every start.
            clock: 16 bytes that identify the monotonic clock of this process.
            age_max_ns: Silence after which another cloud can take the session [ns].
        """
        self._session = session
        self._nonce, self._clock, self._epoch = nonce, clock, NO_EPOCH
        self._cookies = session.ring.keys.current.derive(nonce, b"cookies")
        self._age_max_ns = age_max_ns
        self._fresh_until_ns = -1
        self._incumbent = Hello(b"", b"", b"", NO_EPOCH)
        self._repeated = 0  # acceptances of this epoch since its cloud was last heard
        self._challenged_ns = -CHALLENGE_NS
        self._counters: dict[bytes, int] = {}  # newest counter answered, by nonce
        self._windows = {
            int(kind): Channel(newest_wins=True) for kind in (Kind.ALIVE, Kind.OPERATOR)
        }

    def hear(self, now_ns: int) -> None:
        """Note a new datagram of the session at `now_ns` [ns]: its cloud is alive."""
        self._fresh_until_ns = now_ns + self._age_max_ns
        self._repeated = 0

    def accept_once(self, kind: int, counter: int, now_ns: int) -> None:
        """Accept an ALIVE or OPERATOR datagram of the session once, at `now_ns` [ns].

        Raise the DecodeError "malformed" for other kinds, "repeated" for a counter that is not new.
        """
        window = self._windows.get(kind)
        if window is None:
            raise DecodeError("malformed")
        if window.take(counter) == REPEATED:
            raise DecodeError(REPEATED)
        self.hear(now_ns)

    def receive_hello(self, hello: Hello, counter: int, now_ns: int) -> HelloAnswer:
        """Answer at `now_ns` [ns] the hello that `Session.open` has just verified."""
        session, key = self._session, self._session.greeting_key
        if not self._has_cookie(hello, now_ns):
            if now_ns - self._challenged_ns < CHALLENGE_NS:
                return HelloAnswer("unanswered", [])
            self._challenged_ns = now_ns
            challenge = codec.encode_challenge(self._cookie(now_ns))
            return HelloAnswer("hello", [session.greet(Kind.CHALLENGE, challenge, key)])
        if counter <= self._counters.get(hello.nonce, -1):
            return HelloAnswer(REPEATED, [])
        self._counters.pop(hello.nonce, None)  # so that the nonce answered last is forgotten last
        self._counters[hello.nonce] = counter
        if len(self._counters) > CLOUDS_MAX:
            del self._counters[next(iter(self._counters))]
        if hello.nonce == self._incumbent.nonce:
            if self._keeps_epoch(now_ns):  # cloud takes the answer's key as the key of the epoch
                return HelloAnswer("hello", [self._accept()])
        elif now_ns <= self._fresh_until_ns:
            return HelloAnswer(
                "busy", [session.greet(Kind.BUSY, codec.encode_busy(hello.nonce), key)]
            )
        self._incumbent = hello
        if is_newer(hello.epoch, self._epoch):
            self._epoch = hello.epoch
        self._begin(now_ns)
        session.begin(self._epoch, hello.nonce + self._nonce, key)
        return HelloAnswer("hello", [self._accept()], opened=True)

    def begin_next_epoch(self, now_ns: int) -> bytes:
        """Begin the next epoch of the session at `now_ns` [ns]; return the datagram for cloud."""
        self._begin(now_ns)
        self._session.begin(self._epoch)
        return self._accept()

    def _keeps_epoch(self, now_ns: int) -> bool:
        """Decide whether the cloud with the session keeps its epoch or gets the next epoch.

        It gets the next epoch if the epoch has ended or has an older key than the hello's, or if it
        has asked often although world does not hear it or its hello has another key than the epoch.
        """
        session, key = self._session, self._session.greeting_key
        is_upgrade = session.is_outdated and key == session.ring.keys.current
        if is_upgrade or session.epoch == NO_EPOCH:
            return False
        self._repeated += 1
        is_heard = key == session.epoch_key and now_ns <= self._fresh_until_ns
        return is_heard or self._repeated <= REPEATS_MAX

    def _begin(self, now_ns: int) -> None:
        self._epoch = self._epoch % EPOCH_MAX + 1
        self._fresh_until_ns = now_ns + max(GRACE_NS, self._age_max_ns)
        self._repeated = 0
        for window in self._windows.values():
            window.reset()

    def _accept(self) -> bytes:
        accept = Accept(self._incumbent.nonce, self._nonce, self._clock)
        return self._session.greet(Kind.ACCEPT, codec.encode_accept(accept))

    def _cookie(self, now_ns: int, slots_ago: int = 0) -> bytes:
        slot = now_ns // COOKIE_NS - slots_ago
        return hmac.digest(self._cookies, b"%d" % slot, hashlib.sha256)[: codec.COOKIE_SIZE]

    def _has_cookie(self, hello: Hello, now_ns: int) -> bool:
        cookies = (self._cookie(now_ns), self._cookie(now_ns, slots_ago=1))
        return any(hmac.compare_digest(hello.cookie, cookie) for cookie in cookies)


class ClientHandshake:
    """Cloud's side of the handshake: make hellos and decide which answers are valid."""

    def __init__(self, nonce: bytes, clock: bytes) -> None:
        """Begin without a session; `nonce` and `clock` are as in `ServerHandshake`."""
        self._seed, self._clock = nonce, clock
        self._nonce, self._nonces = nonce, 0
        self._epoch = NO_EPOCH  # the newest one
        self._cookie = NO_COOKIE
        self._replies = 0
        self._cookies: dict[bytes, None] = {}  # received so far, oldest first
        self._world = b""  # nonce of the world process with the session
        self._old_worlds: deque[bytes] = deque(maxlen=WORLDS_MAX)

    def make_hello(self) -> bytes:
        """Make the body of a periodic hello."""
        self._replies = REPLIES_MAX
        return self._hello()

    def answer_challenge(self, cookie: bytes) -> bytes | None:
        """Make the body of the hello that answers a challenge; None if no answer is needed.

        A repeated cookie is ignored, because an older cookie must not replace the newest.
        """
        if self._replies == 0 or cookie in self._cookies:
            return None
        self._replies -= 1
        self._cookie = cookie
        self._cookies[cookie] = None
        if len(self._cookies) > COOKIES_MAX:
            del self._cookies[next(iter(self._cookies))]
        return self._hello()

    def is_refused(self, nonce: bytes) -> bool:
        """Return whether a refusal with this nonce answers a hello of this process."""
        return nonce == self._nonce

    def receive_accept(self, epoch: int, accept: Accept, *, asks: bool) -> bytes | None:
        """Handle an acceptance; return cloud's and world's nonce for the new epoch, or None.

        Cloud accepts another world process only while cloud asks for a session (`asks`), because a
        late datagram of a dead process may arrive. If cloud has accepted a dead process even so,
        the living process counts as old; when it answers again, cloud asks under a new nonce.
        """
        known = accept.world_nonce == self._world
        if accept.nonce != self._nonce or (self._world and not known and not asks):
            return None
        if accept.world_nonce in self._old_worlds:  # ask with a nonce that nobody has captured
            self._nonces += 1
            self._nonce = hashlib.sha256(b"%s %d" % (self._seed, self._nonces)).digest()[:16]
            self._old_worlds.clear()
            return None
        if known and not is_newer(epoch, self._epoch):
            return None
        if self._world and not known:
            self._old_worlds.append(self._world)  # a dead process does not come back
        self._world, self._epoch = accept.world_nonce, epoch
        return accept.nonce + accept.world_nonce

    def _hello(self) -> bytes:
        return codec.encode_hello(Hello(self._nonce, self._clock, self._cookie, self._epoch))


VERSION_TEXT = "peer speaks v{}, we speak v{}: run the same version of cloudrc at both ends"
KEY_TEXT = "the peer uses another key: give both ends the same key file"
BUSY_TEXT = "another cloud controls the robot: this one waits until the other is silent"
SILENCE_TEXT = (
    "world does not answer: is it running, is the link up, do both ends have the same key?"
)


class HandshakeLog:
    """Log why there is no session: each reason once, until the next session begins."""

    def __init__(self) -> None:
        self._logged: set[str] = set()

    def forget(self) -> None:
        """Forget the logged reasons, because a session has begun."""
        self._logged.clear()

    def about(self, outcome: str, data: bytes, now_ns: int) -> list[Fault]:
        """Log at `now_ns` [ns] why a datagram was refused; `outcome` is the DecodeError's text."""
        if outcome == "version":
            return self.say("version", VERSION_TEXT.format(data[0], codec.VERSION), now_ns)
        if outcome == "tag" and codec.peek(data)[0] <= codec.LAST_GREETING:
            return self.say("key", KEY_TEXT, now_ns)
        return []

    def say(self, code: str, text: str, now_ns: int) -> list[Fault]:
        """Log a fault at `now_ns` [ns] unless the same text has been logged.

        The text counts, not the code: a forged datagram must not hide the true peer's version.
        """
        if text in self._logged:
            return []
        self._logged.add(text)
        return [Fault(now_ns, code, text)]
