"""Seal outgoing datagrams and open incoming ones under the keys of one end's session.

Each direction has its own key, derived by HKDF from the pre-shared key, both ends' nonces, the
epoch and the generation. If one of these changes, captured datagrams become worthless. A datagram
changes no state before its tag is verified.

Each kind has its own counter, so that greetings and probes never shift the counters of telemetry
and commands. Counters restart with every epoch, except those of greetings without an epoch: the
link draws its impairments from the counter, and a repeated one would always get the same draw.

A generation is a new pair of keys within an epoch. The sender starts one after 120 s or 2^32
datagrams. The receiver derives the generation that the header names and keeps it if the tag is
right, so a rekey takes no round trip and loses no command. The ends change to a new pre-shared key
in the same way: each announces it by ALIVE datagrams sealed with it, and an end that opens such a
datagram seals with that key from then on.

The header has one byte for the generation. After a long silence the byte can stand for many
generations. Trying them all is slow and a forger could cause it, so it is limited per second.

Two ends in one process may use an unsealed session, because virtual time has no wire to protect and
sealing would take a twentieth of the flight's time. Drivers with a socket refuse such a session
(`Endpoint.sealed`), so a missing key is an error at the start and never plaintext on a wire.
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
"""Number of generations that the header's byte can tell apart."""
AHEAD_MAX = 127
"""Largest number of generations by which an active peer may be ahead of this end [generations]."""
FAR_MAX = 64 * GENERATIONS
"""Number of generations by which a silent peer may be ahead in addition to `AHEAD_MAX`
[generations]. It covers over a week, even at twice the usual rate of rekeys."""
FAR_TRIES = 8
"""Number of datagrams per second for which this end also searches the generations of `FAR_MAX`; one
search takes 0.5 ms."""
SILENCE_NS = 5_000_000_000
"""Time without a new datagram after which a peer is silent [ns]."""
KEPT = 3
"""Number of generations kept open at a time, for late datagrams and an announced key."""

Cipher: TypeAlias = AESGCM | ChaCha20Poly1305
Opener: TypeAlias = tuple[Cipher, Key]


class Openers:
    """The keys that open the peer's datagrams in one epoch.

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
            key: Pre-shared key with which the epoch begins.
            accepted: Pre-shared keys that may follow.
            now_ns: Monotonic clock [ns].
        """
        self._derive = derive
        self.accepted = accepted
        self._kept: dict[int, Opener] = {0: (derive(key, 0), key)}  # by the byte of the generation
        self._newest = 0  # newest generation opened so far
        self._derived: dict[int, list[Opener]] = {}  # by generation
        self._far_tries = FAR_TRIES
        self._heard_ns = now_ns
        self._is_heard = self._is_silent = False

    def accept(self, accepted: tuple[Key, ...]) -> None:
        """Replace the accepted pre-shared keys."""
        self.accepted = accepted
        self._derived = {}
        for byte in [byte for byte, (_, key) in self._kept.items() if key not in accepted]:
            del self._kept[byte]

    def look(self, now_ns: int) -> None:
        """Update whether the peer is silent at `now_ns` [ns]; call it once a second."""
        if self._is_heard:
            self._heard_ns = now_ns
        self._is_heard = False
        self._is_silent = now_ns - self._heard_ns >= SILENCE_NS
        self._far_tries = FAR_TRIES
        self._derived = {}

    def hear(self) -> None:
        """Note that a new datagram was opened."""
        self._is_heard, self._is_silent = True, False

    def open(self, data: bytes, byte: int) -> tuple[bytes, Key, bool]:
        """Open a datagram whose header has this generation byte.

        Returns:
            Its body, its pre-shared key, and whether its generation is new.

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
        """Return the generations that the byte may stand for.

        Some lie a little behind the newest, as their key may not have been accepted until now.
        """
        first = self._newest - KEPT + 1 + (byte - self._newest + KEPT - 1) % GENERATIONS
        first += GENERATIONS * (first < 0)
        last = self._newest + AHEAD_MAX
        if self._is_silent and self._far_tries > 0:
            self._far_tries -= 1
            last += FAR_MAX
        return range(first, last + 1, GENERATIONS)

    def _candidates(self, generation: int) -> list[Opener]:
        """Return the ciphers of a generation; cached against a flood of forged datagrams."""
        if generation not in self._derived:
            self._derived[generation] = [
                (self._derive(key, generation), key) for key in self.accepted
            ]
        return self._derived[generation]

    def _keep(self, generation: int, opener: Opener) -> None:
        if generation > self._newest + KEPT:  # after a silence: newer generations reuse their bytes
            self._kept.clear()
        self._kept[generation % GENERATIONS] = opener
        self._newest = generation
        while len(self._kept) > KEPT:
            del self._kept[next(iter(self._kept))]


ACCEPT, ALIVE = int(Kind.ACCEPT), int(Kind.ALIVE)  # looking up an enum's member is slow
NO_EPOCH = 0
"""Epoch of an end without a session, and of every hello, challenge and refusal."""
TIMELESS = frozenset(range(1, LAST_GREETING + 1)) - {ACCEPT}
"""Kinds of datagram that belong to no epoch: all greetings except ACCEPT."""

AES_256_GCM, CHACHA20_POLY1305 = 1, 2
REKEY_NS = 120_000_000_000
"""Age at which a sender changes its key [ns]. Source: WireGuard, REKEY-AFTER-TIME."""
REKEY_DATAGRAMS = 2**32
"""Number of datagrams of all kinds after which a sender changes its key.
Deviation: WireGuard allows 2^60."""
LOOKS = 3
"""Number of checks in a row that must find the peer with the older key before this end returns to
that key."""


class Agreement(NamedTuple):
    """What two ends agree on in the handshake, and derive the keys of every epoch from.

    Attributes:
        cloud_nonce: 16 bytes.
        world_nonce: 16 bytes.
        suite: Cipher.
    """

    cloud_nonce: bytes
    world_nonce: bytes
    suite: int = AES_256_GCM


class Session:
    """Keys and counters of one end under the current epoch.

    Attributes:
        epoch: Current epoch; `NO_EPOCH` without a session.
        ring: The pre-shared keys.
        accepted: Pre-shared keys that are accepted now.
        greeting_key: Key of the last greeting opened.
        epoch_key: Key with which the epoch began.
    """

    sealed = True

    def __init__(self, sends: Direction, ring: KeyRing, now_ns: int = 0) -> None:
        """Start without a session.

        Args:
            sends: Direction in which this end sends; it opens datagrams of the other one only.
            ring: The pre-shared keys; the session follows changes in flight.
            now_ns: Monotonic clock [ns].
        """
        self.epoch = NO_EPOCH
        self.ring = ring
        self.accepted = ring.accepted(now_ns)
        self._ring_version = ring.version
        self.greeting_key = ring.current
        self._sends, self._opens = int(sends), 1 - int(sends)
        self._counters = dict.fromkeys(map(int, Kind), 0)
        self._agreement: Agreement | None = None
        self._key = self.epoch_key = ring.current
        self._generation = self._generation_byte = 0
        self._rekey_ns: int | None = None
        self._rekey_total = 0
        self._announced: tuple[int, Key, Cipher] | None = None
        self._openers: Openers | None = None  # of the epoch
        self._newest = dict.fromkeys(map(int, Kind), -1)  # newest counter received, by kind
        self._peer_key = ring.current  # with which the peer was last heard
        self._mismatches = 0  # checks in a row that found another key there than ours
        self._tended_ns = now_ns

    def begin(self, epoch: int, agreement: Agreement | None = None, key: Key | None = None) -> None:
        """Begin an epoch: derive new keys and restart the counters.

        Kinds of datagram in TIMELESS belong to no epoch; their counters continue.

        Args:
            epoch: Number of the epoch.
            agreement: Result of the handshake; None keeps that of the previous epoch.
            key: Pre-shared key of the handshake; None keeps the key in use.
        """
        self.epoch = epoch
        self._counters |= dict.fromkeys(self._counters.keys() - TIMELESS, 0)
        self._agreement = agreement or self._agreement
        self._key = self.epoch_key = self._peer_key = key or self._key
        self._generation = self._generation_byte = self._mismatches = 0
        self._rekey_ns = None
        self._rekey_total = self._sent() + REKEY_DATAGRAMS
        self._announced = None
        self._cipher = self._derive(self._key, self._sends, 0)
        self._openers = Openers(self._derive_opening, self._key, self.accepted, self._tended_ns)
        self._newest = dict.fromkeys(self._newest, -1)

    def seal(self, kind: int, body: bytes) -> bytes:
        """Seal `body` as the next datagram of this kind."""
        counters = self._counters
        counter = counters[kind]
        counters[kind] = counter + 1
        header = encode_header(kind, self._sends, self.epoch, counter, self._generation_byte)
        return header + self._cipher.encrypt(header[4:], body, header)

    def greet(self, kind: int, body: bytes, key: Key | None = None) -> bytes:
        """Make a greeting authenticated with a pre-shared key, by default the one in use."""
        counter = self._counters[kind]
        self._counters[kind] = counter + 1
        epoch = NO_EPOCH if kind in TIMELESS else self.epoch
        data = encode_header(kind, self._sends, epoch, counter) + body
        return data + (key or self._key).tag(data)

    def open(self, data: bytes) -> Datagram:
        """Verify and decode a datagram; nothing changes unless its tag is right.

        Raises:
            DecodeError: "malformed", "version", "direction" (our own direction), "old_epoch"
                (another epoch) or "tag".
        """
        _, direction, epoch, generation, kind, counter = check(data)
        if direction != self._opens:
            raise DecodeError("direction")
        if self._ring_version != self.ring.version:
            self._update_keys()
        if kind <= LAST_GREETING:
            return kind, direction, epoch, counter, self._open_greeting(data)
        if epoch != self.epoch or not epoch:
            raise DecodeError("old_epoch")
        assert self._openers is not None, "an epoch has openers"
        body, key, is_new = self._openers.open(data, generation)
        if counter >> 63:  # a recording holds signed 64-bit integers
            raise DecodeError("malformed")
        if counter > self._newest[kind]:  # anybody can repeat an older datagram
            self._newest[kind] = counter
            self._hear(key, is_new)
        return kind, direction, epoch, counter, body

    def next_counter(self, kind: int) -> int:
        """Return the counter of the next datagram of this kind."""
        return self._counters[kind]

    def maintain(self, now_ns: int) -> list[bytes]:
        """Do what is due: rekey, adopt new keys, drop old ones; call it once a second.

        Returns:
            Datagrams to send: the announcement of a key that the peer has not used yet.
        """
        self._tended_ns = now_ns
        self._update_keys()
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

    def _update_keys(self) -> None:
        """Adopt the keys of the ring; keys that are no longer accepted open nothing."""
        self._ring_version = self.ring.version
        self.accepted = self.ring.accepted(self._tended_ns)
        if self._openers is not None and self._openers.accepted != self.accepted:
            self._openers.accept(self.accepted)

    def _hear(self, key: Key, is_new: bool) -> None:
        """Note the key of a datagram; in a new generation it may be only an announcement."""
        assert self._openers is not None
        self._openers.hear()
        if not is_new:
            self._peer_key = key
        elif key == self.ring.current != self._key:
            self._move_on(key)

    def _key_for_peer(self) -> Key:
        """Return the key to seal with: the peer's, because it may not have ours any more."""
        peer = self._peer_key if self._peer_key in self.accepted else self.ring.current
        self._mismatches = self._mismatches + 1 if peer != self._key else 0
        looks = 1 if peer == self.ring.current or self._key not in self.accepted else LOOKS
        return peer if self._mismatches >= looks else self._key

    def _sent(self) -> int:
        return sum(self._counters.values())

    def _move_on(self, key: Key) -> None:
        """Seal with the next generation of this key from now on."""
        self._generation = self._next_generation
        self._generation_byte = self._generation % GENERATIONS
        self._key = key
        self._mismatches = 0
        self._cipher = self._derive(key, self._sends, self._generation)
        self._announced = None

    @property
    def _next_generation(self) -> int:
        return 1 + (self._announced[0] if self._announced else self._generation)

    def _announce(self) -> bytes:
        """Make a datagram sealed with the new key, which tells the peer that this end has it."""
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
        assert self._agreement is not None, "the handshake comes first"
        cloud, world, suite = self._agreement
        use = b"session %d %d %d %d" % (suite, direction, self.epoch, generation)
        secret = key.derive(cloud + world, use)
        return AESGCM(secret) if suite == AES_256_GCM else ChaCha20Poly1305(secret)


def pair(
    epoch: int = 1, secret: bytes = bytes(32), suite: int = AES_256_GCM
) -> tuple[Session, Session]:
    """Make world's and cloud's end of a session for tests; equal arguments give equal keys."""
    world, cloud = (
        Session(sends, KeyRing(KeySet(Key(secret))))
        for sends in (Direction.UPLINK, Direction.DOWNLINK)
    )
    for end in (world, cloud):
        end.begin(epoch, Agreement(b"cloud".ljust(16), b"world".ljust(16), suite))
    return world, cloud


NO_SECRET = KeySet(Key(bytes(32)))
"""Key of the greetings within one process, where nothing is secret."""
NO_TAG = bytes(TAG_SIZE)


class UnsealedSession(Session):
    """A session for two ends in one process: datagrams keep their length but have no tag."""

    sealed = False

    def __init__(self, sends: Direction) -> None:
        """Start without a session."""
        super().__init__(sends, KeyRing(NO_SECRET))

    def seal(self, kind: int, body: bytes) -> bytes:
        """Seal `body` as the next datagram of this kind."""
        counter = self._counters[kind]
        self._counters[kind] = counter + 1
        return encode_header(kind, self._sends, self.epoch, counter) + body + NO_TAG

    def open(self, data: bytes) -> Datagram:
        """Check and decode a datagram.

        Raises:
            DecodeError: As in `Session.open`; "tag" for greetings only.
        """
        _, direction, epoch, _, kind, counter = check(data)
        if direction != self._opens:
            raise DecodeError("direction")
        if kind <= LAST_GREETING:
            return kind, direction, epoch, counter, self._open_greeting(data)
        if epoch != self.epoch or not epoch:
            raise DecodeError("old_epoch")
        return kind, direction, epoch, counter, data[HEADER_SIZE:-TAG_SIZE]

    def maintain(self, now_ns: int) -> list[bytes]:
        """Do nothing: an unsealed session has no keys to change."""
        return []


def make_session(sends: Direction, ring: KeyRing | None, now_ns: int = 0) -> Session:
    """Make an end's session: sealed if it has keys, else unsealed and only for one process."""
    return UnsealedSession(sends) if ring is None else Session(sends, ring, now_ns)
