"""Greetings, world's side: how a cloud gets a session, and why nobody else does.

    cloud                                      world
      HELLO (nonce, clock, no cookie)   -->
                                        <--    CHALLENGE (cookie)
      HELLO (nonce, clock, cookie)      -->
                                        <--    ACCEPT (nonce, world's nonce, clock), a new epoch
                                            or BUSY (nonce)

All of them carry a tag by the pre-shared key: who does not have it is not answered at all. The
cookie is a MAC over the current two seconds, so world keeps nothing for a hello without it, and a
captured hello is worth nothing four seconds later. No answer is longer than what it answers, and
there are at most 20 of them in any second: ten challenges, ten other answers. A captured hello that
somebody repeats can use up the challenges alone, and these, which name nobody, lead the honest
cloud on all the same; a hello with a cookie is answered once per counter.

The cloud that has the session keeps it while it is heard: one datagram, new and sealed with the
session's keys, in `command_age_max`. Only after that another one gets it, under the next epoch. A
nonce that has had its session never gets another: a captured hello cannot bring back an old one.

Deviation: WireGuard derives session keys by Diffie-Hellman too; here the pre-shared key is all, as
both ends are one owner's, and whoever has that key can command the robot anyway.

Greetings, cloud's side: what its hellos say, and which answers count.

World's side, and what goes over the wire, is in `cloudrc.tunnel.handshake`.

What keeps two ends from having a session, in words for the user, and each only once.
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
ANSWERS_MAX = 10
"""Answers in any second to hellos with a cookie; challenges have the same limit.
Source: WireGuard, 20 handshakes per second and address: both limits together."""
SECOND_NS = 1_000_000_000
CHALLENGE_NS = SECOND_NS // 10
"""Between two challenges [ns]; spread over the second, so that none waits long for the next."""
COOKIE_NS = 2_000_000_000
"""A cookie is valid in its slot of this length and in the next one [ns]."""
GRACE_NS = 1_000_000_000
"""Authority of a cloud whose session is new, until it is heard for the first time [ns]."""
REPEATS_MAX = 3
"""An incumbent that is accepted so often and goes on asking gets a new epoch, under its own key, if
it has another one than the epoch began with, which it has dropped before it learnt of the epoch, or
is not heard, so that there is nothing to lose."""
USED_MAX = 64
"""Old nonces remembered; at ten answers a second none is forgotten while its cookie is valid."""


def epochs_after(last: int) -> Iterator[int]:
    """Count epochs on; after the last that the header can hold comes 1: nonces are fresh then."""
    while True:
        last = last % EPOCH_MAX + 1
        yield last


class Answer(NamedTuple):
    """What world does about a hello.

    Attributes:
        outcome: What it is counted under.
        datagrams: To be sent, none or one.
        opened: Whether a new session has been opened.
    """

    outcome: str
    datagrams: list[bytes]
    opened: bool = False


class Identity(Protocol):
    """What the door asks of world's identity; `cloudrc.world.identity` explains it."""

    @property
    def clock_id(self) -> bytes:
        """Names this machine's monotonic clock."""

    @property
    def nonce(self) -> bytes:
        """Names this process."""

    @property
    def suite(self) -> int:
        """Cipher that world would like."""

    @property
    def last_epoch(self) -> int:
        """The last one before this process."""

    @property
    def next_epoch(self) -> Callable[[], int | None] | None:
        """Gives persisted epochs, or None while there is none."""


class Door:
    """World's side: who has authority, who gets it next, and under which epoch."""

    def __init__(self, session: Session, identity: Identity, *, age_max_ns: int) -> None:
        """Begin without a session.

        Args:
            session: World's; from here on its epochs are opened here.
            identity: World's.
            age_max_ns: How long an incumbent may be silent [ns].
        """
        self._session = session
        self._nonce, self._clock, self._suite = identity.nonce, identity.clock_id, identity.suite
        self._next_epoch = identity.next_epoch or epochs_after(identity.last_epoch).__next__
        self._coming: int | None = None  # the epoch to begin next, once it is asked for
        self._cookies = session.ring.current.derive(identity.nonce, b"cookies")
        self._age_max_ns = age_max_ns
        self._fresh_until_ns = -1
        self._incumbent = Hello(b"", b"", b"", AES_256_GCM)
        self._repeated = 0  # acceptances of this epoch, since its cloud was last heard
        self._used: deque[bytes] = deque(maxlen=USED_MAX)
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
        """Whether there is an epoch to begin: a disk that hangs may have none for a while."""
        if self._coming is None:
            self._coming = self._next_epoch()
        return self._coming is not None

    def hear(self, now_ns: int) -> None:
        """Note that the incumbent is alive: a new datagram of its session has come [ns]."""
        self._fresh_until_ns = now_ns + self._age_max_ns
        self._repeated = 0

    def admit(self, kind: int, counter: int, now_ns: int) -> None:
        """Let an ALIVE or OPERATOR datagram of the session in, once [ns, monotonic clock].

        Raises:
            DecodeError: "malformed" if it is neither, "repeated".
        """
        window = self._windows.get(kind)
        if window is None:
            raise DecodeError("malformed")
        if window.take(counter) == REPEATED:
            raise DecodeError(REPEATED)
        self.hear(now_ns)

    def knock(self, hello: Hello, counter: int, now_ns: int) -> Answer:
        """Decide about the hello that the session has just opened.

        Args:
            hello: Its body.
            counter: From its header.
            now_ns: Monotonic clock [ns].
        """
        if not self._has_cookie(hello, now_ns):
            if now_ns - self._challenged_ns < CHALLENGE_NS:
                return Answer("unanswered", [])
            self._challenged_ns = now_ns
            return self._answer("hello", CHALLENGE, encode_challenge(self._cookie(now_ns)))
        if counter <= self._counters.get(hello.nonce, -1):
            return Answer(REPEATED, [])
        answered = self._answered_ns
        if len(answered) == ANSWERS_MAX and now_ns - answered[0] < SECOND_NS:
            return Answer("unanswered", [])
        answered.append(now_ns)
        self._remember(hello.nonce, counter)
        if hello.nonce == self._incumbent.nonce:
            session = self._session
            self._repeated += 1
            begun_with_it = session.greeting_key == session.epoch_key
            if self._repeated <= REPEATS_MAX or (begun_with_it and now_ns <= self._fresh_until_ns):
                # Whichever key this hello has: cloud takes the answer's for the key of the epoch.
                return Answer("hello", [session.greet(ACCEPT, self._accept(), session.epoch_key)])
        elif hello.nonce in self._used:
            return self._answer("hello", BUSY, encode_busy(Busy(hello.nonce, used=True)))
        elif now_ns <= self._fresh_until_ns:
            return self._answer("busy", BUSY, encode_busy(Busy(hello.nonce, used=False)))
        if not self.ready:
            return Answer("unanswered", [])
        if hello.nonce != self._incumbent.nonce:
            self._used.append(self._incumbent.nonce)
        self._incumbent = hello
        self._fresh_until_ns = now_ns + max(GRACE_NS, self._age_max_ns)
        agreement = Agreement(hello.nonce, self._nonce, self._agreed())
        self._begin(agreement, self._session.greeting_key)
        return self._answer("hello", ACCEPT, self._accept(), opened=True)

    def move_on(self, now_ns: int) -> bytes:
        """Open the next epoch of the same session [ns], if `ready`; the datagram to tell cloud."""
        self._begin()
        self._fresh_until_ns = now_ns + max(GRACE_NS, self._age_max_ns)  # until it can be heard
        return self._session.greet(ACCEPT, self._accept())

    def _remember(self, nonce: bytes, counter: int) -> None:
        counters = self._counters
        counters.pop(nonce, None)  # the one that is answered last is forgotten last
        counters[nonce] = counter
        if len(counters) > USED_MAX:
            del counters[next(iter(counters))]

    def _begin(self, agreement: Agreement | None = None, key: Key | None = None) -> None:
        epoch, self._coming = self._coming or self._next_epoch(), None
        assert epoch is not None, "ask whether it is `ready`"
        self._session.begin(epoch, agreement, key)
        self._repeated = 0
        for window in self._windows.values():
            window.reset()

    def _accept(self) -> bytes:
        accept = Accept(self._incumbent.nonce, self._nonce, self._clock, self._agreed())
        return encode_accept(accept)

    def _agreed(self) -> int:
        wishes = (self._incumbent.suite, self._suite)
        return CHACHA20_POLY1305 if CHACHA20_POLY1305 in wishes else AES_256_GCM

    def _answer(self, outcome: str, kind: int, body: bytes, *, opened: bool = False) -> Answer:
        session = self._session
        return Answer(outcome, [session.greet(kind, body, session.greeting_key)], opened)

    def _cookie(self, now_ns: int, slots_ago: int = 0) -> bytes:
        slot = now_ns // COOKIE_NS - slots_ago
        return hmac.digest(self._cookies, b"%d" % slot, hashlib.sha256)[:16]

    def _has_cookie(self, hello: Hello, now_ns: int) -> bool:
        return any(
            hmac.compare_digest(hello.cookie, self._cookie(now_ns, slots_ago))
            for slots_ago in (0, 1)
        )


NO_COOKIE = bytes(16)
REPLIES_MAX = 3
"""Challenges that cloud answers at once, between two hellos of its own accord."""
COOKIES_MAX = 4096
"""Cookies that cloud remembers: over two hours of world's, a slot each."""
EPOCHS = 2**32
"""An epoch that is less than half of them ahead is newer; after the last one comes 1."""
LEFT_MAX = 64
"""Earlier world processes remembered."""


class Knocker:
    """Cloud's side: what its hellos say, and which answers count."""

    def __init__(self, nonce: bytes, clock: bytes, suite: int) -> None:
        """Begin without a session.

        Args:
            nonce: 16 bytes that name this process; new ones at every start.
            clock: 16 bytes that name its monotonic clock.
            suite: Cipher that cloud would like.
        """
        self._seed, self._clock, self._suite = nonce, clock, suite
        self._nonce, self._nonces = nonce, 0
        self._cookie = NO_COOKIE
        self._replies = 0
        self._cookies: dict[bytes, None] = {}  # that have come, in their order
        self._world = b""
        self._left: deque[bytes] = deque(maxlen=LEFT_MAX)

    def hello(self) -> bytes:
        """The body of a hello of cloud's own accord."""
        self._replies = REPLIES_MAX
        return self._hello()

    def challenged(self, cookie: bytes) -> bytes | None:
        """Take a challenge; the body of the hello that answers it, or None if it needs none.

        A cookie that has come before is left alone: it is in the next hello if it is the newest,
        and an old one that somebody repeats must not take the place of that.
        """
        if self._replies == 0 or cookie in self._cookies:
            return None
        self._replies -= 1
        self._cookie = cookie
        self._cookies[cookie] = None
        if len(self._cookies) > COOKIES_MAX:
            del self._cookies[next(iter(self._cookies))]
        return self._hello()

    def refused(self, busy: Busy) -> bool:
        """Take a refusal; whether it is one of what cloud asks for, by another's authority."""
        if busy.nonce != self._nonce:
            return False
        if busy.used:  # ours, but lost to another cloud meanwhile
            self._rename()
        return not busy.used

    def accepted(self, epoch: int, accept: Accept, current: int, *, asks: bool) -> Agreement | None:
        """Take an acceptance.

        Another world is taken while cloud asks only: what a process that is gone has sent may come
        late. Was it taken all the same, the one that lives is among those left: it answers what
        cloud goes on asking, and is asked under another name.

        Args:
            epoch: From its header.
            accept: Its body.
            current: Epoch of the session until now.
            asks: Whether cloud wants a session: it has none, or does not hear world in it.

        Returns:
            What the session under the new epoch rests on; None if this is not for us, or old.
        """
        known = accept.world_nonce == self._world
        if accept.nonce != self._nonce or (self._world and not known and not asks):
            return None
        if accept.world_nonce in self._left:
            self._rename()
            return None
        if known:
            if not 0 < (epoch - current) % EPOCHS < EPOCHS // 2:
                return None
        elif self._world:
            self._left.append(self._world)  # a process that is gone does not come back
        self._world = accept.world_nonce
        return Agreement(accept.nonce, accept.world_nonce, accept.suite)

    def _rename(self) -> None:
        """Ask under another name, of which nothing has been captured."""
        self._nonces += 1
        text = b"%s %d" % (self._seed, self._nonces)
        self._nonce = hashlib.sha256(text).digest()[:16]
        self._left.clear()

    def _hello(self) -> bytes:
        return encode_hello(Hello(self._nonce, self._clock, self._cookie, self._suite))


KEY = "greetings come that our key does not fit: give both ends the same key file"
BUSY_TEXT = "another cloud controls the robot: this one waits until that is silent"
NO_EPOCH = "no session and no mission from the spawn can begin: the disk keeps the epochs waiting"
SILENCE = "world does not answer: is it running, is the link up, do both ends have the same key?"


class Complaints:
    """Remembers what has been said since the last session began."""

    def __init__(self) -> None:
        """Begin with nothing said."""
        self._said: set[str] = set()

    def forget(self) -> None:
        """There is a session again."""
        self._said.clear()

    def about(self, outcome: str, data: bytes, now_ns: int) -> list[Fault]:
        """Explain a refused datagram while there is no session [ns, own clock]."""
        if outcome == "version":
            text = (
                f"peer speaks v{data[0]}, we speak v{VERSION}: "
                "run the same version of cloudrc at both ends"
            )
            return self.say("version", text, now_ns)
        if outcome == "tag" and peek(data)[0] <= LAST_GREETING:
            return self.say("key", KEY, now_ns)
        return []

    def say(self, code: str, text: str, now_ns: int) -> list[Fault]:
        """Say something unless these words have been said [ns, own clock].

        Anybody may send a datagram of another version: it does not hide what the peer's is.
        """
        if text in self._said:
            return []
        self._said.add(text)
        return [Fault(now_ns, code, text)]
