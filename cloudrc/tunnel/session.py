"""One end's session: datagrams of its epoch are sealed on the way out and opened on the way in.

`seal` and `open` are the only way to the wire. Keys, one per direction, come by HKDF from the
pre-shared key, both ends' nonces, the epoch and the generation: a change of any of them makes what
was captured before worthless. Nothing changes before a tag has been verified.

Counters run per kind, so that probes and greetings never shift those of telemetry and commands;
they start again with every epoch, but for the greetings that belong to none: a link decides by the
counter, and a repeated one would meet the same fate for ever.

A generation is a new pair of keys within an epoch. The sender moves on by itself after 120 s or
2^32 datagrams; the receiver derives what the header asks for, and keeps it if the tag fits. So a
rekey takes no round trip, resets nothing, and no command is missed. Two keys of a key file change
over in the same way: each end announces the new one by ALIVE datagrams sealed with it, and whoever
opens such a datagram seals with that key from then on.

For tests: `pair()` makes both ends of a session, sealed, the same ones for the same arguments. A
whole end is sealed if its identity has keys: `WorldIdentity(clock, nonce, ring=KeyRing(...))`.

What opens the peer's datagrams: the keys of its newest generations, found by one byte.

A sender moves on to the next generation by itself, and after a silence, or while this machine
slept, by any number of them: the byte in the header then stands for several. Trying them all takes
time that a forger could ask for, too, so it is done for a few datagrams in each second alone.

A session without keys, for two ends in one process: virtual time has no wire to protect.

Sealing two datagrams takes some 4 us per 10 ms of flight, a twentieth of what a virtual flight
takes at all. An end has such a session if it was given no keys; a driver with a socket refuses it
(`Endpoint.sealed`), so forgetting the key is an error at the start and never plaintext on a wire.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import AESGCM, ChaCha20Poly1305

from cloudrc.tunnel.codec import (
    HEADER_SIZE,
    LAST_GREETING,
    TAG_SIZE,
    Datagram,
    DecodeError,
    Direction,
    Kind,
    check,
    encode_header,
)
from cloudrc.tunnel.keys import Key, KeyRing, KeySet

GENERATIONS = 256
AHEAD_MAX = 127
"""Generations that a peer that is heard may be ahead; the header has one byte of them."""
FAR_MAX = 64 * GENERATIONS
"""And so many more one that is not: over a week, for a peer that moves on twice as often."""
FAR_TRIES = 8
"""Datagrams between two looks for which those are tried, at 0.5 ms each."""
SILENCE_NS = 5_000_000_000
"""Without anything new for so long a peer is not heard [ns]."""
KEPT = 3
"""Generations that are opened side by side: late datagrams, and a key that is announced."""

Cipher: TypeAlias = AESGCM | ChaCha20Poly1305
Opener: TypeAlias = tuple[Cipher, Key]


class Openers:
    """The keys of one session that open what arrives.

    Attributes:
        accepted: Pre-shared keys from which they may be derived.
    """

    def __init__(
        self,
        derive: Callable[[Key, int], Cipher],
        key: Key,
        accepted: tuple[Key, ...],
        now_ns: int,
    ) -> None:
        """Begin an epoch.

        Args:
            derive: Makes the cipher of a pre-shared key and a generation.
            key: That the epoch begins with.
            accepted: Those that may follow.
            now_ns: When [ns].
        """
        self._derive = derive
        self.accepted = accepted
        self._kept: dict[int, Opener] = {0: (derive(key, 0), key)}  # by the byte of the generation
        self._newest = 0  # generation that was opened for the first time last
        self._tried: dict[int, list[Opener]] = {}
        self._far_tries = FAR_TRIES
        self._heard_ns = now_ns
        self._is_heard = self._is_silent = False

    def accept(self, accepted: tuple[Key, ...]) -> None:
        """From now on these pre-shared keys count, and no others."""
        self.accepted = accepted
        self._tried = {}
        for byte in [byte for byte, (_, key) in self._kept.items() if key not in accepted]:
            del self._kept[byte]

    def look(self, now_ns: int) -> None:
        """Take note of the time [ns]; once a second."""
        if self._is_heard:
            self._heard_ns = now_ns
        self._is_heard = False
        self._is_silent = now_ns - self._heard_ns >= SILENCE_NS
        self._far_tries = FAR_TRIES
        self._tried = {}

    def hear(self) -> None:
        """Something new has been opened."""
        self._is_heard, self._is_silent = True, False

    def open(self, data: bytes, byte: int) -> tuple[bytes, Key, bool]:
        """Open a datagram whose header has this byte of its generation.

        Returns:
            Its body, the pre-shared key behind it, and whether its generation is new to us.

        Raises:
            DecodeError: "tag".
        """
        opener = self._kept.get(byte)
        if opener is not None:
            try:
                return opener[0].decrypt(data[4:16], data[16:], data[:16]), opener[1], False
            except InvalidTag:
                if not self._is_silent:
                    raise DecodeError("tag") from None
        for generation in self._generations(byte):
            for cipher, key in self._candidates(generation):
                try:
                    body = cipher.decrypt(data[4:16], data[16:], data[:16])
                except InvalidTag:
                    continue
                self._keep(generation, (cipher, key))
                return body, key, True
        raise DecodeError("tag")

    def _generations(self, byte: int) -> range:
        """Those that the byte may stand for.

        One a little behind the newest is, too, if its key was not accepted for a while.
        """
        first = self._newest - KEPT + 1 + (byte - self._newest + KEPT - 1) % GENERATIONS
        first += GENERATIONS * (first < 0)
        last = self._newest + AHEAD_MAX
        if self._is_silent and self._far_tries > 0:
            self._far_tries -= 1
            last += FAR_MAX
        return range(first, last + 1, GENERATIONS)

    def _candidates(self, generation: int) -> list[Opener]:
        """What may open a generation; kept, so that a flood of forged ones derives no key twice."""
        if generation not in self._tried:
            self._tried[generation] = [
                (self._derive(key, generation), key) for key in self.accepted
            ]
        return self._tried[generation]

    def _keep(self, generation: int, opener: Opener) -> None:
        if generation > self._newest + KEPT:  # after a silence: their bytes are the next ones' soon
            self._kept.clear()
        self._kept[generation % GENERATIONS] = opener
        self._newest = generation
        while len(self._kept) > KEPT:
            del self._kept[next(iter(self._kept))]


ACCEPT, ALIVE = int(Kind.ACCEPT), int(Kind.ALIVE)  # an enum's member is slow to look up
NO_EPOCH = 0
"""The epoch of an end that has no session, and of every hello, challenge and refusal."""
TIMELESS = frozenset(range(1, LAST_GREETING + 1)) - {ACCEPT}
"""Kinds that belong to no epoch."""

AES_256_GCM, CHACHA20_POLY1305 = 1, 2
REKEY_NS = 120_000_000_000
"""Age at which a sender changes its key [ns]. Source: WireGuard, REKEY-AFTER-TIME."""
REKEY_DATAGRAMS = 2**32
"""Datagrams of all kinds after which a sender changes its key.
Deviation: WireGuard allows 2^60."""
LOOKS = 3
"""In a row at which the peer is heard with the key before, until this end goes back to it."""


class Agreement(NamedTuple):
    """What the greetings of two ends agree on; with it each derives the keys of every epoch.

    Attributes:
        cloud_nonce: 16 bytes.
        world_nonce: 16 bytes.
        suite: Cipher.
    """

    cloud_nonce: bytes
    world_nonce: bytes
    suite: int = AES_256_GCM


class Session:
    """What one end needs to talk under one epoch."""

    sealed = True

    def __init__(self, sends: Direction, ring: KeyRing, now_ns: int = 0) -> None:
        """Start without a session.

        Args:
            sends: The direction that this end sends in; it opens only the other one's datagrams.
            ring: The pre-shared keys; followed in flight.
            now_ns: Monotonic clock [ns].
        """
        self.epoch = NO_EPOCH
        self.ring = ring
        self.accepted = ring.accepted(now_ns)
        self._ring_version = ring.version
        self.greeting_key = ring.current  # that the last greeting was opened with
        self._sends, self._opens = int(sends), 1 - int(sends)
        self._counters = dict.fromkeys(map(int, Kind), 0)
        self._agreement: Agreement | None = None
        self._key = self.epoch_key = ring.current  # in use; that the epoch began with
        self._generation = self._generation_byte = 0
        self._rekey_ns: int | None = None
        self._rekey_total = 0
        self._announced: tuple[int, Key, Cipher] | None = None
        self._openers: Openers | None = None  # of the epoch
        self._newest = dict.fromkeys(map(int, Kind), -1)  # counters that the peer was heard with
        self._heard = ring.current  # key that it was last heard with
        self._apart = 0  # looks in a row at which that was another one than ours
        self._tended_ns = now_ns

    def begin(self, epoch: int, agreement: Agreement | None = None, key: Key | None = None) -> None:
        """Begin a new epoch: new keys, and counters start again but for those of no epoch.

        Args:
            epoch: Its number.
            agreement: Of the greetings; None for that of the epoch before.
            key: That they were authenticated with; None for the one in use.
        """
        self.epoch = epoch
        self._counters |= dict.fromkeys(self._counters.keys() - TIMELESS, 0)
        self._agreement = agreement or self._agreement
        self._key = self.epoch_key = self._heard = key or self._key
        self._generation = self._generation_byte = self._apart = 0
        self._rekey_ns = None
        self._rekey_total = self._sent() + REKEY_DATAGRAMS
        self._announced = None
        self._cipher = self._derive(self._key, self._sends, 0)
        self._openers = Openers(self._derive_opening, self._key, self.accepted, self._tended_ns)
        self._newest = dict.fromkeys(self._newest, -1)

    def seal(self, kind: int, body: bytes) -> bytes:
        """Make the datagram of the session that carries `body`."""
        counters = self._counters
        counter = counters[kind]
        counters[kind] = counter + 1
        header = encode_header(kind, self._sends, self.epoch, counter, self._generation_byte)
        return header + self._cipher.encrypt(header[4:], body, header)

    def greet(self, kind: int, body: bytes, key: Key | None = None) -> bytes:
        """Make a greeting, authenticated with a pre-shared key; by default the one in use."""
        counter = self._counters[kind]
        self._counters[kind] = counter + 1
        epoch = NO_EPOCH if kind in TIMELESS else self.epoch
        data = encode_header(kind, self._sends, epoch, counter) + body
        return data + (key or self._key).tag(data)

    def open(self, data: bytes) -> Datagram:
        """Verify a datagram and take it apart; nothing changes unless its tag is right.

        Raises:
            DecodeError: "malformed", "version", "direction" for one of our own direction,
                "old_epoch" for one of another epoch, or "tag".
        """
        _, direction, epoch, generation, kind, counter = check(data)
        if direction != self._opens:
            raise DecodeError("direction")
        if self._ring_version != self.ring.version:
            self._take_up_keys()
        if kind <= LAST_GREETING:
            return kind, direction, epoch, counter, self._open_greeting(data)
        if epoch != self.epoch or not epoch:
            raise DecodeError("old_epoch")
        assert self._openers is not None, "an epoch has them"
        body, key, anew = self._openers.open(data, generation)
        if counter >> 63:  # nobody counts as far, and what is flown by it could not be recorded
            raise DecodeError("malformed")
        if counter > self._newest[kind]:  # what is repeated anybody can send
            self._newest[kind] = counter
            self._hear(key, anew)
        return kind, direction, epoch, counter, body

    def next_counter(self, kind: int) -> int:
        """The counter that the next datagram of this kind will carry."""
        return self._counters[kind]

    def tend(self, now_ns: int) -> list[bytes]:
        """Do what time asks for: rekey, take up new keys, drop old ones; call it once a second.

        Returns:
            Datagrams to send: the announcement of a key that the peer has not used yet.
        """
        self._tended_ns = now_ns
        self._take_up_keys()
        if self._openers is None:
            return []
        self._openers.look(now_ns)
        if self._rekey_ns is None:
            self._rekey_ns = now_ns + REKEY_NS
        if (key := self._key_for_peer()) != self._key:
            self._move_on(key)
        elif now_ns >= self._rekey_ns or self._sent() >= self._rekey_total:
            self._move_on(self._key)
            self._rekey_ns, self._rekey_total = now_ns + REKEY_NS, self._sent() + REKEY_DATAGRAMS
        return [] if self._key == self.ring.current else [self._announce()]

    def _take_up_keys(self) -> None:
        """A key that is not accepted any more opens nothing from now on."""
        self._ring_version = self.ring.version
        self.accepted = self.ring.accepted(self._tended_ns)
        if self._openers is not None and self._openers.accepted != self.accepted:
            self._openers.accept(self.accepted)

    def _hear(self, key: Key, anew: bool) -> None:
        """The peer seals with this key, or, in a generation that is new, announces it perhaps."""
        assert self._openers is not None
        self._openers.hear()
        if not anew:
            self._heard = key
        elif key == self.ring.current != self._key:
            self._move_on(key)

    def _key_for_peer(self) -> Key:
        """The one to seal with: which the peer is heard with, for it may not have ours any more."""
        heard = self._heard if self._heard in self.accepted else self.ring.current
        self._apart = self._apart + 1 if heard != self._key else 0
        looks = 1 if heard == self.ring.current or self._key not in self.accepted else LOOKS
        return heard if self._apart >= looks else self._key

    def _sent(self) -> int:
        return sum(self._counters.values())

    def _move_on(self, key: Key) -> None:
        """Seal with the next generation, of this key."""
        self._generation = self._next_generation
        self._generation_byte = self._generation % GENERATIONS
        self._key = key
        self._apart = 0
        self._cipher = self._derive(key, self._sends, self._generation)
        self._announced = None

    @property
    def _next_generation(self) -> int:
        return 1 + (self._announced[0] if self._announced else self._generation)

    def _announce(self) -> bytes:
        """Say, sealed with the new key, that this end has it."""
        key = self.ring.current
        if self._announced is None or self._announced[1] != key:
            generation = self._next_generation
            self._announced = generation, key, self._derive(key, self._sends, generation)
        generation, _, cipher = self._announced
        counter = self._counters[ALIVE]
        self._counters[ALIVE] = counter + 1
        header = encode_header(ALIVE, self._sends, self.epoch, counter, generation % GENERATIONS)
        return header + cipher.encrypt(header[4:], b"", header)

    def _open_greeting(self, data: bytes) -> bytes:
        signed, tag = data[:-TAG_SIZE], data[-TAG_SIZE:]
        for key in self.accepted:
            if key.verifies(signed, tag):
                self.greeting_key = key
                return signed[HEADER_SIZE:]
        raise DecodeError("tag")

    def _derive_opening(self, key: Key, generation: int) -> Cipher:
        return self._derive(key, self._opens, generation)

    def _derive(self, key: Key, direction: int, generation: int) -> Cipher:
        assert self._agreement is not None, "greetings come first"
        cloud, world, suite = self._agreement
        use = b"session %d %d %d %d" % (suite, direction, self.epoch, generation)
        secret = key.derive(cloud + world, use)
        return AESGCM(secret) if suite == AES_256_GCM else ChaCha20Poly1305(secret)


def pair(
    epoch: int = 1, secret: bytes = bytes(32), suite: int = AES_256_GCM
) -> tuple[Session, Session]:
    """Make world's and cloud's end of one session, for tests; the same for the same arguments."""
    world, cloud = (
        Session(sends, KeyRing(KeySet(Key(secret))))
        for sends in (Direction.UPLINK, Direction.DOWNLINK)
    )
    for end in (world, cloud):
        end.begin(epoch, Agreement(b"cloud".ljust(16), b"world".ljust(16), suite))
    return world, cloud


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
