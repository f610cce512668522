"""The handshake of a session: world's side, cloud's side, and the log of why it fails.

    cloud                                      world
      HELLO (nonce, clock, no cookie)   -->
                                        <--    CHALLENGE (cookie)
      HELLO (nonce, clock, cookie)      -->
                                        <--    ACCEPT (nonce, world's nonce, clock), a new epoch
                                            or BUSY (nonce)

Every greeting has a tag by the pre-shared key; world does not answer a sender without that key. The
cookie is a MAC over a time slot of two seconds, so world stores nothing for a hello without a
cookie, and a captured hello is useless after four seconds. No answer is longer than its hello.
World sends at most 20 answers per second: ten challenges and ten others. A repeated captured hello
can use up only the challenges, and the honest cloud can use these, too, because they name nobody. A
hello with a cookie is answered once per counter.

The cloud with the session keeps it while world hears it: at least one new sealed datagram per
`command_age_max`. After that another cloud can get a session under the next epoch. A nonce gets
only one session, so a captured hello cannot bring back an old one.

Deviation: WireGuard also derives session keys by Diffie-Hellman. Here the pre-shared key is enough,
because one owner has both ends, and anybody with that key can command the robot anyway.
"""

from __future__ import annotations

import hashlib
import hmac
from collections import deque
from collections.abc import Callable, Iterator
from typing import NamedTuple, Protocol

from cloudrc.records import Fault
from cloudrc.tunnel.channel import REPEATED, Channel
from cloudrc.tunnel.codec import (
    LAST_GREETING,
    VERSION,
    Accept,
    Busy,
    DecodeError,
    Hello,
    Kind,
    encode_accept,
    encode_busy,
    encode_challenge,
    encode_hello,
    peek,
)
from cloudrc.tunnel.keys import Key
from cloudrc.tunnel.session import ACCEPT, AES_256_GCM, ALIVE, CHACHA20_POLY1305, Agreement, Session

BUSY, CHALLENGE, OPERATOR = int(Kind.BUSY), int(Kind.CHALLENGE), int(Kind.OPERATOR)

EPOCH_MAX = 2**32 - 1
"""Last epoch that the header can hold."""
ANSWERS_MAX = 10
"""Largest number of answers per second to hellos with a cookie; challenges have the same limit.
Source: WireGuard, 20 handshakes per second and address; here both limits together give 20."""
SECOND_NS = 1_000_000_000
CHALLENGE_NS = SECOND_NS // 10
"""Least time between two challenges [ns]."""
COOKIE_NS = 2_000_000_000
"""Length of a cookie's time slot [ns]; a cookie is valid in its slot and in the next one."""
GRACE_NS = 1_000_000_000
"""Time for which a cloud keeps a new session before it is heard for the first time [ns]."""
REPEATS_MAX = 3
"""Number of times that world repeats its acceptance to the same cloud.

After that a new epoch begins under the key of the cloud's greeting, unless that is the key of the
present epoch and the cloud is still heard.
"""
USED_MAX = 64
"""Number of old nonces remembered; none is forgotten while its cookie is valid."""


def epochs_after(last: int) -> Iterator[int]:
    """Count epochs upwards; after EPOCH_MAX comes 1, because the nonces are new by then."""
    while True:
        last = last % EPOCH_MAX + 1
        yield last


class HelloAnswer(NamedTuple):
    """World's answer to a hello.

    Attributes:
        outcome: Name under which the hello is counted.
        datagrams: Datagrams to send, none or one.
        opened: Whether a new session has been opened.
    """

    outcome: str
    datagrams: list[bytes]
    opened: bool = False


class Identity(Protocol):
    """The part of world's identity that the handshake needs."""

    @property
    def clock_id(self) -> bytes:
        """Bytes that identify this machine's monotonic clock."""

    @property
    def nonce(self) -> bytes:
        """Bytes that identify this process."""

    @property
    def suite(self) -> int:
        """Cipher that world prefers."""

    @property
    def last_epoch(self) -> int:
        """Last epoch before this process."""

    @property
    def next_epoch(self) -> Callable[[], int | None] | None:
        """Function that returns the next persisted epoch, or None while there is none."""


class ServerHandshake:
    """World's side: decide which cloud has authority, and under which epoch."""

    def __init__(self, session: Session, identity: Identity, *, age_max_ns: int) -> None:
        """Begin without a session.

        Args:
            session: World's session; this class begins its epochs.
            identity: World's identity.
            age_max_ns: Longest silence of the cloud that has the session; after it, another cloud
                may take the session [ns].
        """
        self._session = session
        self._nonce, self._clock, self._suite = identity.nonce, identity.clock_id, identity.suite
        self._next_epoch = identity.next_epoch or epochs_after(identity.last_epoch).__next__
        self._reserved_epoch: int | None = None  # the epoch to begin next
        self._cookies = session.ring.current.derive(identity.nonce, b"cookies")
        self._age_max_ns = age_max_ns
        self._fresh_until_ns = -1
        self._incumbent = Hello(b"", b"", b"", AES_256_GCM)
        self._repeated = 0  # acceptances of this epoch since its cloud was last heard
        self._used: deque[bytes] = deque(maxlen=USED_MAX)  # nonces that have had a session
        self._challenged_ns = -CHALLENGE_NS
        self._answered_ns: deque[int] = deque(maxlen=ANSWERS_MAX)
        self._counters: dict[bytes, int] = {}  # newest counter answered, by nonce
        self._windows = {int(kind): Channel(newest_wins=True) for kind in (ALIVE, OPERATOR)}

    @property
    def shares_clock(self) -> bool:
        """Whether the cloud that has the session reads the same clock as world."""
        return self._incumbent.clock == self._clock

    @property
    def ready(self) -> bool:
        """Whether the next epoch is available; the file of epochs may delay it."""
        if self._reserved_epoch is None:
            self._reserved_epoch = self._next_epoch()
        return self._reserved_epoch is not None

    def hear(self, now_ns: int) -> None:
        """Note a new datagram of the session at `now_ns` [ns]: its cloud is alive."""
        self._fresh_until_ns = now_ns + self._age_max_ns
        self._repeated = 0

    def accept_once(self, kind: int, counter: int, now_ns: int) -> None:
        """Accept an ALIVE or OPERATOR datagram of the session once.

        Args:
            kind: Kind of the datagram.
            counter: Counter in its header.
            now_ns: Monotonic clock [ns].

        Raises:
            DecodeError: "malformed" if it has another kind, "repeated".
        """
        window = self._windows.get(kind)
        if window is None:
            raise DecodeError("malformed")
        if window.take(counter) == REPEATED:
            raise DecodeError(REPEATED)
        self.hear(now_ns)

    def receive_hello(self, hello: Hello, counter: int, now_ns: int) -> HelloAnswer:
        """Answer the hello that the session has just opened.

        Args:
            hello: Body of the hello.
            counter: Counter in its header.
            now_ns: Monotonic clock [ns].
        """
        if not self._has_cookie(hello, now_ns):
            if now_ns - self._challenged_ns < CHALLENGE_NS:
                return HelloAnswer("unanswered", [])
            self._challenged_ns = now_ns
            return self._answer("hello", CHALLENGE, encode_challenge(self._cookie(now_ns)))
        if counter <= self._counters.get(hello.nonce, -1):
            return HelloAnswer(REPEATED, [])
        answered = self._answered_ns
        if len(answered) == ANSWERS_MAX and now_ns - answered[0] < SECOND_NS:
            return HelloAnswer("unanswered", [])
        answered.append(now_ns)
        self._remember(hello.nonce, counter)
        if hello.nonce == self._incumbent.nonce:
            session = self._session
            self._repeated += 1
            same_key = session.greeting_key == session.epoch_key
            if self._repeated <= REPEATS_MAX or (same_key and now_ns <= self._fresh_until_ns):
                # Not the key of this hello: cloud uses the answer's key as the key of the epoch.
                return HelloAnswer(
                    "hello", [session.greet(ACCEPT, self._accept(), session.epoch_key)]
                )
        elif hello.nonce in self._used:
            return self._answer("hello", BUSY, encode_busy(Busy(hello.nonce, used=True)))
        elif now_ns <= self._fresh_until_ns:
            return self._answer("busy", BUSY, encode_busy(Busy(hello.nonce, used=False)))
        if not self.ready:
            return HelloAnswer("unanswered", [])
        if hello.nonce != self._incumbent.nonce:
            self._used.append(self._incumbent.nonce)
        self._incumbent = hello
        self._fresh_until_ns = now_ns + max(GRACE_NS, self._age_max_ns)
        agreement = Agreement(hello.nonce, self._nonce, self._common_suite())
        self._begin(agreement, self._session.greeting_key)
        return self._answer("hello", ACCEPT, self._accept(), opened=True)

    def begin_next_epoch(self, now_ns: int) -> bytes:
        """Begin the next epoch of the same session and make the datagram that tells cloud.

        Call it only if `ready`.

        Args:
            now_ns: Monotonic clock [ns].
        """
        self._begin()
        self._fresh_until_ns = now_ns + max(GRACE_NS, self._age_max_ns)
        return self._session.greet(ACCEPT, self._accept())

    def _remember(self, nonce: bytes, counter: int) -> None:
        counters = self._counters
        counters.pop(nonce, None)  # so that the nonce answered last is forgotten last
        counters[nonce] = counter
        if len(counters) > USED_MAX:
            del counters[next(iter(counters))]

    def _begin(self, agreement: Agreement | None = None, key: Key | None = None) -> None:
        epoch, self._reserved_epoch = self._reserved_epoch or self._next_epoch(), None
        assert epoch is not None, "check `ready` first"
        self._session.begin(epoch, agreement, key)
        self._repeated = 0
        for window in self._windows.values():
            window.reset()

    def _accept(self) -> bytes:
        accept = Accept(self._incumbent.nonce, self._nonce, self._clock, self._common_suite())
        return encode_accept(accept)

    def _common_suite(self) -> int:
        preferred = (self._incumbent.suite, self._suite)
        return CHACHA20_POLY1305 if CHACHA20_POLY1305 in preferred else AES_256_GCM

    def _answer(self, outcome: str, kind: int, body: bytes, *, opened: bool = False) -> HelloAnswer:
        session = self._session
        return HelloAnswer(outcome, [session.greet(kind, body, session.greeting_key)], opened)

    def _cookie(self, now_ns: int, slots_ago: int = 0) -> bytes:
        slot = now_ns // COOKIE_NS - slots_ago
        return hmac.digest(self._cookies, b"%d" % slot, hashlib.sha256)[:16]

    def _has_cookie(self, hello: Hello, now_ns: int) -> bool:
        return any(
            hmac.compare_digest(hello.cookie, self._cookie(now_ns, slots_ago))
            for slots_ago in (0, 1)
        )


NO_COOKIE = bytes(16)
"""Cookie of the first hello."""
REPLIES_MAX = 3
"""Largest number of challenges that cloud answers between two periodic hellos."""
COOKIES_MAX = 4096
"""Number of cookies that cloud remembers, one per time slot; together they cover over two hours."""
EPOCHS = 2**32
"""Number of different epochs. An epoch is newer than another one if it is ahead by less than half
of this number."""
LEFT_MAX = 64
"""Number of earlier world processes that cloud remembers."""


class ClientHandshake:
    """Cloud's side: make hellos and decide which answers are valid."""

    def __init__(self, nonce: bytes, clock: bytes, suite: int) -> None:
        """Begin without a session.

        Args:
            nonce: 16 bytes that identify this process, new at every start.
            clock: 16 bytes that identify its monotonic clock.
            suite: Cipher that cloud prefers.
        """
        self._seed, self._clock, self._suite = nonce, clock, suite
        self._nonce, self._nonces = nonce, 0
        self._cookie = NO_COOKIE
        self._replies = 0
        self._cookies: dict[bytes, None] = {}  # received so far, oldest first
        self._world = b""  # nonce of the world process with the session
        self._old_worlds: deque[bytes] = deque(maxlen=LEFT_MAX)

    def make_hello(self) -> bytes:
        """Make the body of a periodic hello."""
        self._replies = REPLIES_MAX
        return self._hello()

    def answer_challenge(self, cookie: bytes) -> bytes | None:
        """Handle a challenge and make the body of the hello that answers it.

        A repeated cookie is ignored: the next hello has it if it is the newest, and an older one
        must not replace the newest.

        Returns:
            The body, or None if no answer is needed.
        """
        if self._replies == 0 or cookie in self._cookies:
            return None
        self._replies -= 1
        self._cookie = cookie
        self._cookies[cookie] = None
        if len(self._cookies) > COOKIES_MAX:
            del self._cookies[next(iter(self._cookies))]
        return self._hello()

    def receive_busy(self, busy: Busy) -> bool:
        """Handle a refusal.

        Returns:
            Whether it answers our hello and another cloud has authority.
        """
        if busy.nonce != self._nonce:
            return False
        if busy.used:  # our session was lost to another cloud
            self._change_nonce()
        return not busy.used

    def receive_accept(
        self, epoch: int, accept: Accept, current: int, *, asks: bool
    ) -> Agreement | None:
        """Handle an acceptance.

        Cloud accepts another world process only while it asks for a session, because a late
        datagram of a dead process may arrive. If cloud has accepted a dead process nevertheless,
        the living one counts as old; when it answers again, cloud asks under a new nonce.

        Args:
            epoch: Epoch in the header.
            accept: Body of the datagram.
            current: Epoch of the session until now.
            asks: Whether cloud wants a session: it has none, or does not hear world.

        Returns:
            The agreement for the new epoch; None if the acceptance is old or not for us.
        """
        known = accept.world_nonce == self._world
        if accept.nonce != self._nonce or (self._world and not known and not asks):
            return None
        if accept.world_nonce in self._old_worlds:
            self._change_nonce()
            return None
        if known:
            if not 0 < (epoch - current) % EPOCHS < EPOCHS // 2:
                return None
        elif self._world:
            self._old_worlds.append(self._world)  # a dead process does not come back
        self._world = accept.world_nonce
        return Agreement(accept.nonce, accept.world_nonce, accept.suite)

    def _change_nonce(self) -> None:
        """Use a new nonce, of which nobody can have captured datagrams."""
        self._nonces += 1
        text = b"%s %d" % (self._seed, self._nonces)
        self._nonce = hashlib.sha256(text).digest()[:16]
        self._old_worlds.clear()

    def _hello(self) -> bytes:
        return encode_hello(Hello(self._nonce, self._clock, self._cookie, self._suite))


KEY_TEXT = "the peer uses another key: give both ends the same key file"
BUSY_TEXT = "another cloud controls the robot: this one waits until the other is silent"
NO_EPOCH_TEXT = (
    "no session and no mission from the spawn can begin: the disk delays the file of epochs"
)
SILENCE_TEXT = (
    "world does not answer: is it running, is the link up, do both ends have the same key?"
)


class HandshakeLog:
    """Log each reason why there is no session once, until the next session begins."""

    def __init__(self) -> None:
        """Begin with nothing logged."""
        self._logged: set[str] = set()

    def forget(self) -> None:
        """Start again, because there is a session."""
        self._logged.clear()

    def about(self, outcome: str, data: bytes, now_ns: int) -> list[Fault]:
        """Log why a datagram was refused while there is no session.

        Args:
            outcome: Text of the DecodeError.
            data: The datagram.
            now_ns: Own clock [ns].
        """
        if outcome == "version":
            text = (
                f"peer speaks v{data[0]}, we speak v{VERSION}: "
                "run the same version of cloudrc at both ends"
            )
            return self.say("version", text, now_ns)
        if outcome == "tag" and peek(data)[0] <= LAST_GREETING:
            return self.say("key", KEY_TEXT, now_ns)
        return []

    def say(self, code: str, text: str, now_ns: int) -> list[Fault]:
        """Log a fault unless the same text has been logged.

        The text decides, not the code: a datagram with any version, which anybody can send, does
        not hide the version of the peer.

        Args:
            code: Code of the fault.
            text: Text of the fault.
            now_ns: Own clock [ns].
        """
        if text in self._logged:
            return []
        self._logged.add(text)
        return [Fault(now_ns, code, text)]
