# SPDX-License-Identifier: Apache-2.0

"""The handshake that opens a session: world's side, cloud's side, and the texts of failures.

    cloud                                      world
      HELLO (nonce, clock, no cookie)   -->
                                        <--    CHALLENGE (cookie)
      HELLO (nonce, clock, cookie)      -->
                                        <--    ACCEPT (nonce, world's nonce, clock), a new epoch
                                            or BUSY (nonce)

docs/wire.md explains cookies, epochs, keys, and which cloud gets the session.

Deviation: WireGuard also derives session keys by Diffie-Hellman. This tunnel uses only the
pre-shared key: one owner has both ends, and anybody with the key can command the robot anyway.
"""

from __future__ import annotations

import hashlib
import hmac
from collections import deque
from typing import NamedTuple

from cloudrc.wire.tunnel import codec
from cloudrc.wire.tunnel.codec import Accept, DecodeError, Hello, Kind
from cloudrc.wire.tunnel.session import NO_EPOCH, Session
from cloudrc.wire.tunnel.window import REPEATED, ReceiveWindow

EPOCH_MAX = 2**32 - 1  # largest session number that the header can hold; the next number is 1
CHALLENGE_NS = 100_000_000  # shortest time between two challenges [ns]
COOKIE_NS = 2_000_000_000  # length of a time slot; a cookie is valid in its slot and the next [ns]
GRACE_NS = 1_000_000_000  # time limit for the first encrypted datagram of a new session [ns]
REPEATS_MAX = 3  # repeats of ACCEPT to a cloud that shows no sign of the epoch's key
CLOUDS_MAX = 64  # number of cloud processes of which world remembers the newest hello
NO_COOKIE = bytes(codec.COOKIE_SIZE)  # cookie in a hello for which cloud has no cookie from world
REPLIES_MAX = 3  # largest number of challenges that cloud answers per periodic hello
COOKIES_MAX = 4096  # number of cookies that cloud remembers: those of two hours, one every 2 s
WORLDS_MAX = 64  # cloud ignores late answers from at most this many earlier world processes


def is_newer(epoch: int, than: int) -> bool:
    """Return whether `epoch` is later than `than`; after EPOCH_MAX the numbers begin again at 1."""
    return 0 < (epoch - than) % (EPOCH_MAX + 1) <= EPOCH_MAX // 2


class HelloAnswer(NamedTuple):
    """World's answer to a HELLO: its outcome, datagrams to send, whether a session has begun."""

    outcome: str
    datagrams: list[bytes]
    opened: bool = False


class ServerHandshake:
    """World's side of the handshake: decide which cloud gets a session, and number sessions."""

    def __init__(self, session: Session, nonce: bytes, clock: bytes, age_max_ns: int) -> None:
        """Start without a session; each handshake then sets the epoch and keys of `session`.

        `nonce` identifies this process, and `clock` the monotonic clock of this machine; both have
        16 bytes. If cloud is silent for `age_max_ns` [ns], another cloud can get a session.
        """
        self._session = session
        self._nonce, self._clock, self._epoch = nonce, clock, NO_EPOCH
        self._cookies = session.ring.keys.current.derive(nonce, b"cookies")
        self._age_max_ns = age_max_ns
        self._fresh_until_ns = -1
        self._incumbent = Hello(b"", b"", b"", NO_EPOCH)
        self._repeated = 0  # HELLOs with another key since the last sign of the epoch's key
        self._challenged_ns = -CHALLENGE_NS
        self._counters: dict[bytes, int] = {}  # newest counter answered, by nonce
        self._windows = {
            int(kind): ReceiveWindow(newest_wins=True) for kind in (Kind.ALIVE, Kind.OPERATOR)
        }

    def hear(self, now_ns: int) -> None:
        """Extend the session at `now_ns` [ns], because a new datagram of its cloud has arrived."""
        self._fresh_until_ns = now_ns + self._age_max_ns
        self._repeated = 0

    def accept_once(self, kind: int, counter: int, now_ns: int) -> None:
        """Extend the session at `now_ns` [ns] by an ALIVE or OPERATOR datagram.

        Raise the DecodeError "repeated" if a datagram with this kind and counter has arrived
        before, and "malformed" for any other kind.
        """
        window = self._windows.get(kind)
        if window is None:
            raise DecodeError("malformed")
        if window.take(counter) == REPEATED:
            raise DecodeError(REPEATED)
        self.hear(now_ns)

    def receive_hello(self, hello: Hello, counter: int, now_ns: int) -> HelloAnswer:
        """Answer a HELLO at `now_ns` [ns], after `Session.open` has verified the datagram."""
        session, key = self._session, self._session.handshake_key
        if not self._has_cookie(hello, now_ns):
            if now_ns - self._challenged_ns < CHALLENGE_NS:
                return HelloAnswer("unanswered", [])
            self._challenged_ns = now_ns
            challenge = codec.encode(Kind.CHALLENGE, self._cookie(now_ns))
            return HelloAnswer("hello", [session.sign(Kind.CHALLENGE, challenge, key)])
        if counter <= self._counters.get(hello.nonce, -1):
            return HelloAnswer(REPEATED, [])
        self._counters.pop(hello.nonce, None)  # the nonce answered last comes last
        self._counters[hello.nonce] = counter
        if len(self._counters) > CLOUDS_MAX:
            del self._counters[next(iter(self._counters))]
        if hello.nonce == self._incumbent.nonce:
            if self._keeps_epoch(hello):  # with the epoch's key
                return HelloAnswer("hello", [self._accept()])
        elif now_ns <= self._fresh_until_ns:
            return HelloAnswer(
                "busy",
                [session.sign(Kind.BUSY, codec.encode(Kind.BUSY, hello.nonce), key)],
            )
        self._incumbent = hello
        if is_newer(hello.epoch, self._epoch):
            self._epoch = hello.epoch
        self._begin(now_ns)
        session.begin(self._epoch, hello.nonce + self._nonce, key)
        return HelloAnswer("hello", [self._accept()], opened=True)

    def begin_next_epoch(self, now_ns: int) -> bytes:
        """Begin a new session with the same cloud at `now_ns` [ns]; return its ACCEPT datagram."""
        self._begin(now_ns)
        self._session.begin(self._epoch)
        return self._accept()

    def _keeps_epoch(self, hello: Hello) -> bool:
        """Return whether the present epoch continues after a repeated HELLO of the session's cloud.

        Over a slow link with losses, many HELLOs are under way before cloud gets the first answer.
        They do not end the epoch. It ends if an end has left it, which the epoch in `hello` shows
        for cloud, and after a HELLO with a newer key. More than REPEATS_MAX HELLOs with another key
        end it, too, if nothing else arrives in between: cloud has lost the epoch's key.
        """
        session, key = self._session, self._session.handshake_key
        is_upgrade = session.is_outdated and key == session.ring.keys.current
        is_left = session.epoch == NO_EPOCH or is_newer(hello.epoch, self._epoch)
        if is_upgrade or is_left:
            return False
        self._repeated = 0 if key == session.epoch_key else self._repeated + 1
        return self._repeated <= REPEATS_MAX

    def _begin(self, now_ns: int) -> None:
        self._epoch = self._epoch % EPOCH_MAX + 1
        self._fresh_until_ns = now_ns + max(GRACE_NS, self._age_max_ns)
        self._repeated = 0
        for window in self._windows.values():
            window.reset()

    def _accept(self) -> bytes:
        accept = Accept(self._incumbent.nonce, self._nonce, self._clock)
        return self._session.sign(Kind.ACCEPT, codec.encode(Kind.ACCEPT, *accept))

    def _cookie(self, now_ns: int, slots_ago: int = 0) -> bytes:
        slot = now_ns // COOKIE_NS - slots_ago
        return hmac.digest(self._cookies, b"%d" % slot, hashlib.sha256)[: codec.COOKIE_SIZE]

    def _has_cookie(self, hello: Hello, now_ns: int) -> bool:
        cookies = (self._cookie(now_ns), self._cookie(now_ns, slots_ago=1))
        return any(hmac.compare_digest(hello.cookie, cookie) for cookie in cookies)


class ClientHandshake:
    """Cloud's side of the handshake: make HELLOs, and decide which answers are valid."""

    def __init__(self, nonce: bytes, clock: bytes) -> None:
        """Start without a session; `nonce` identifies this process, `clock` the machine's clock."""
        self._seed, self._clock = nonce, clock
        self._nonce, self._nonces = nonce, 0
        self._epoch, self._left = NO_EPOCH, False  # the newest known epoch; whether cloud left it
        self._cookie = NO_COOKIE
        self._replies = 0
        self._cookies: dict[bytes, None] = {}  # received so far, oldest first
        self._world = b""  # nonce of the world process with the session
        self._old_worlds: deque[bytes] = deque(maxlen=WORLDS_MAX)

    def leave(self) -> None:
        """Leave the newest epoch for good: to join it again would repeat its counters.

        The next HELLO names the epoch after it, so that world begins a later one.
        """
        self._left = self._epoch != NO_EPOCH

    def make_hello(self) -> bytes:
        """Make the body of a periodic HELLO."""
        self._replies = REPLIES_MAX
        return self._hello()

    def answer_challenge(self, cookie: bytes) -> bytes | None:
        """Make the body of the HELLO that answers a challenge; None to send no HELLO.

        Return None for a repeated cookie, because an old cookie must not replace the newest one.
        Also return None after REPLIES_MAX answers since the last periodic HELLO.
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
        """Return whether a BUSY datagram with this nonce answers a HELLO of this process."""
        return nonce == self._nonce

    def receive_accept(self, epoch: int, accept: Accept, *, asks: bool) -> bytes | None:
        """Process an ACCEPT; return cloud's and world's nonce if a new epoch begins, else None.

        `asks` is True while cloud asks for a session; only then does cloud accept a new world
        process. A delayed ACCEPT can make cloud accept a world process that has ended. When the
        running world process then answers, cloud changes its own nonce, so that all delayed
        ACCEPTs become invalid.
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
            self._old_worlds.append(self._world)  # an ended process does not come back
        self._world, self._epoch, self._left = accept.world_nonce, epoch, False
        return accept.nonce + accept.world_nonce

    def _hello(self) -> bytes:
        epoch = self._epoch % EPOCH_MAX + 1 if self._left else self._epoch
        return codec.encode(Kind.HELLO, self._nonce, self._clock, self._cookie, epoch)


DAMAGE = "or the link damages packets (link.*.corrupt)"
"""What else a datagram with another version or key may mean: one bit of it was flipped."""
VERSION_TEXT = (
    f"peer speaks v{{}}, we speak v{{}}: run the same version of cloudrc at both ends, {DAMAGE}"
)
KEY_TEXT = f"the peer uses another key: give both ends the same key file, {DAMAGE}"
BUSY_TEXT = "another cloud controls the robot: this one waits until the other is silent"
SILENCE_TEXT = (
    "world does not answer: is it running, is the link up, do both ends have the same key?"
)
