"""What opens the peer's datagrams: the keys of its newest generations, found by one byte.

A sender moves on to the next generation by itself, and after a silence, or while this machine
slept, by any number of them: the byte in the header then stands for several. Trying them all takes
time that a forger could ask for, too, so it is done for a few datagrams in each second alone.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import AESGCM, ChaCha20Poly1305

from cloudrc.tunnel.codec import DecodeError
from cloudrc.tunnel.keys import Key

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
