# SPDX-License-Identifier: Apache-2.0

"""Open the model of a link for any program: no clock, no socket, no process.

A program asks when each of its packets arrives, in its own time. The answer depends on seed,
direction, stream, episode and number of the packet alone, so two policies meet the same network.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from cloudrc.base.outside.refusal import naming
from cloudrc.base.outside.values import Quantity
from cloudrc.link.draws import (
    BLOCK,
    Copies,
    Floats,
    Purpose,
    StreamKey,
    stream_key,
    uniforms_of,
)
from cloudrc.link.model import LinkDirection
from cloudrc.link.profile import (
    DIRECTIONS,
    RANDOM,
    Conditions,
    DirectionProfile,
    Start,
    going_round,
)

if TYPE_CHECKING:
    from cloudrc.link.streams import Numbers

KIND = 128
"""Kind of the packets of other programs; smaller numbers are those of the testbed's datagrams."""
BEYOND = 132
"""Kind of the pieces that a message has beyond the usual number."""
PACKET_BYTES = 1200
"""Most bytes of a message that one packet carries, by default [bytes]."""
SEED = Quantity(ge=0, le=2**53 - 1, whole=True)
"""Seed of a link, as in an experiment."""
COUNT = Quantity(ge=0, le=2**63 - 1, whole=True)
"""Number of a packet or of an episode, size, or time [ns]."""
PERIOD = Quantity("s", ge=1e-9, le=1e9)
"""Time between two packets."""
_PACKETS = 10_000  # of which `expected` is computed
_BYTE = b"\0"  # stands for the content of a packet
_BEYOND = 1024  # counters of a message for its pieces beyond the usual number
_CHUNK = 64  # number of blocks that are computed together; their arrays fit into the cache


class Piece(NamedTuple):
    """A packet with a part of a message."""

    kind: int  # with the counter, it selects the random numbers
    counter: int
    size: int  # [bytes]


@dataclass(frozen=True)
class Cut:
    """How the messages of one direction are cut into packets.

    No two pieces of an episode share kind and counter, whatever the sizes of the messages: piece k
    of message m has the counter m times `usual` plus k. The pieces beyond the usual number have a
    kind of their own, with room for 1,024 of them.
    """

    packet_bytes: int = PACKET_BYTES  # most bytes of a piece
    usual: int = 1  # number of pieces of a message of the usual size

    def for_size(self, size: int) -> Cut:
        """Return the cut for messages that usually have `size` bytes."""
        return replace(self, usual=self.count(size))

    def count(self, size: int) -> int:
        """Return the number of pieces of a message of `size` bytes; an empty one is a packet."""
        return max(1, -(-size // self.packet_bytes))

    def piece(self, number: int, size: int, place: int) -> Piece:
        """Return the piece in a place, from 0 on, of a message with its number and `size`."""
        length = min(self.packet_bytes, size - place * self.packet_bytes)
        if place < self.usual:
            return Piece(KIND, number * self.usual + place, length)
        return Piece(BEYOND, number * _BEYOND + place - self.usual, length)

    def pieces(self, number: int, size: int) -> list[Piece]:
        """Return all pieces of a message."""
        return [self.piece(number, size, place) for place in range(self.count(size))]


@dataclass(frozen=True)
class LinkProfile:
    """Both directions of a link, with the contents of the files that they name."""

    uplink: DirectionProfile
    downlink: DirectionProfile
    start_s: Start | None = None  # where an episode begins in the schedule [s], or random; None: 0

    def __post_init__(self) -> None:
        if self.start_s == RANDOM:  # then schedules repeat
            for way in DIRECTIONS:
                object.__setattr__(self, way, going_round(getattr(self, way)))

    @property
    def period_ns(self) -> int:
        """The longer period of both directions [ns]; 0 if none has one."""
        return max(way.period_ns or 0 for way in (self.uplink, self.downlink))

    def start_ns(self, seed: int, episode: int, stream: str = "") -> int:
        """Return where in its schedule an episode begins [ns], equal for both directions."""
        if self.start_s is None:
            return 0
        from cloudrc.link.start import start_ns  # here: few links have a schedule

        return start_ns((self.uplink, self.downlink), self.start_s, seed, episode, stream)


def read_profile(profile: str | Path | Mapping[str, Any] | LinkProfile) -> LinkProfile:
    """Read a link profile: the name of a shipped one, the path of a file, or a mapping.

    A mapping has the keys of a file. The files that a profile names are read, too.

    Raises:
        BadInputError: If there is no such profile, or if it is wrong; the text says what to change.
    """
    if isinstance(profile, LinkProfile):
        return profile
    # Here, because a program that makes its profile itself needs no YAML.
    from cloudrc.link.profile_file import read_keys, with_files

    keys = read_keys(profile)
    return LinkProfile(with_files(keys.uplink), with_files(keys.downlink), keys.start_s)


def open(
    profile: str | Path | Mapping[str, Any] | LinkProfile, seed: int, *, stream: str = ""
) -> tuple[OneWay, OneWay]:
    """Open a link; return its uplink and its downlink.

    Args:
        profile: Name of a shipped profile, path of a file, mapping with the keys of a file, or the
            result of `read_profile`.
        seed: Seed of all random numbers, from 0 to 2^53 - 1.
        stream: Name of the link. Links with one seed and different names share no random numbers:
            give each robot its name. Flights of the testbed have the empty name.

    Raises:
        BadInputError: If the profile cannot be used; the text says what to change.
    """
    both = read_profile(profile)
    start = partial(both.start_ns, seed, stream=stream)
    return OneWay(both.uplink, seed, True, stream=stream, start=start), OneWay(
        both.downlink, seed, False, stream=stream, start=start
    )


class OneWay:
    """One direction of a link: it says when each packet arrives.

    An episode is a use of the link from its start: time begins at 0 ns, and a bottleneck is empty.
    Packets of a new episode end the old one. If the profile has a rate or `keep_order`, packets
    must be sent in the order of time.

    Attributes:
        profile: The conditions.
    """

    def __init__(
        self,
        profile: DirectionProfile,
        seed: int,
        uplink: bool,
        *,
        stream: str = "",
        start: Callable[[int], int] | None = None,
    ) -> None:
        """Open a direction; `seed` and `stream` are those of `cloudrc.link.open`.

        `start` returns where in its schedule an episode begins [ns]; without it, at 0.
        """
        with naming("seed"):
            self._seed = SEED.of(seed)
        self.profile = profile
        self._uplink, self._stream, self._start = uplink, stream, start
        self._episode = 0
        self._usual: int | None = None  # size of the first message of the episode [bytes]
        self._link = self._new(0)

    def send(self, episode: int, number: int, size: int, now_ns: int) -> Copies:
        """Send one packet, whatever its size; compute when it arrives.

        `send_message` cuts what does not fit into a packet of a network.

        Args:
            episode: Number of the episode, at least 0.
            number: Number of the packet in its episode, at least 0. It selects the random numbers.
            size: Size of the packet without headers of UDP and IP [bytes]; only a rate needs it.
            now_ns: Time of sending since the episode began [ns].

        Returns:
            Times of arrival [ns]: none for a lost packet, two for a duplicated one, of which the
            second may be the first to arrive. A damaged packet counts as lost.

        Raises:
            BadInputError: If an argument is negative, or `episode` or `number` is not whole.
        """
        if episode != self._episode:
            (episode,) = _whole(episode=episode)
            self._begin(episode)
        try:  # takes less time than to check each packet
            if type(number) is not int or not (size >= 0 and now_ns >= 0):  # also NaN
                raise TypeError
            arrivals = self._link.send(episode, KIND, number, size, now_ns)
        except (IndexError, OverflowError, TypeError, ValueError):
            number, size, now_ns = _whole(number=number, size=size, now_ns=now_ns)
            arrivals = self._link.send(episode, KIND, number, size, now_ns)
        if self._link.corrupts and self._link.corrupted(episode, KIND, number, _BYTE) != _BYTE:
            return ()
        return arrivals

    def send_message(
        self,
        episode: int,
        number: int,
        size: int,
        now_ns: int,
        *,
        usual: int | None = None,
        packet_bytes: int = PACKET_BYTES,
    ) -> Copies:
        """Send a message as packets that leave at one instant; compute when it is whole.

        Each packet is delayed and lost by itself; a message of one packet as by `send`. Do not use
        both in one episode.

        Args:
            episode: Number of the episode, at least 0.
            number: Number of the message in its episode, at least 0.
            size: Size of the message [bytes].
            now_ns: Time of sending since the episode began [ns].
            usual: Size of most messages [bytes], which decides the counters of packets. None: that
                of the first message of the episode.
            packet_bytes: Most bytes of a packet.

        Returns:
            When the last packet arrives [ns]; nothing if one is lost. Of two copies the first
            counts.

        Raises:
            BadInputError: If an argument is negative or not whole, or `packet_bytes` is 0.
        """
        episode, number, size, now_ns = _whole(
            episode=episode, number=number, size=size, now_ns=now_ns
        )
        with naming("packet_bytes"):
            packet_bytes = COUNT.of(packet_bytes or -1)
        if episode != self._episode:
            self._begin(episode)
        if usual is None:
            usual = self._usual = size if self._usual is None else self._usual
        (usual,) = _whole(usual=usual)
        cut = Cut(packet_bytes).for_size(usual)
        arrivals, _ = self._link.send_pieces(episode, cut.pieces(number, size), now_ns)
        return arrivals

    def table(
        self,
        count: int,
        period: float,
        *,
        episode: int = 0,
        first: int = 0,
        size: int = 100,
    ) -> Floats:
        """Compute the delays of many packets at once, for simulators that work with arrays.

        Equal to `send` for one packet after the other in a new episode: packet n, from `first` on,
        leaves at n times the period. If two copies arrive, the first counts.

        Args:
            count: Number of packets.
            period: Time between two packets [s].
            episode: Number of the episode.
            first: Number of the first packet.
            size: Size of each packet [bytes].

        Returns:
            The delays [s], shape (count,); NaN for a lost packet.
        """
        count, episode, first, size = _whole(count=count, episode=episode, first=first, size=size)
        period_ns = _to_ns(period)
        conditions = self._link.only
        if conditions and _is_independent(self.profile, conditions):
            return self._independent(conditions, episode, first, count)
        from cloudrc.link.streams import sample

        sent_ns = range(first * period_ns, (first + count) * period_ns, period_ns)
        return sample(self._new(episode), KIND, sent_ns, size, epoch=episode, first=first).delays

    def expected(self, period: float = 0.01, size: int = 100) -> Numbers:
        """Compute what the profile asks for: statistics of 10,000 packets from the model.

        The random numbers are not those of the episodes. The packets leave once per `period` [s]
        from the start of the schedule on and have `size` bytes. They meet many phases of a radio
        whose phase is random.
        """
        from cloudrc.link.streams import numbers, sample

        (size,) = _whole(size=size)
        link = LinkDirection(
            self.profile, self._seed, self._uplink, stream=f"{self._stream} expected"
        )
        period_ns = _to_ns(period)
        sent_ns = range(0, _PACKETS * period_ns, period_ns)
        return numbers(sample(link, KIND, sent_ns, size, turn=self.profile.phase_packets))

    def begin(self, episode: int) -> LinkDirection:
        """Begin an episode anew; return its model, whose `send` checks no argument."""
        (episode,) = _whole(episode=episode)
        self._begin(episode)
        return self._link

    def _begin(self, episode: int) -> None:
        self._episode, self._usual = episode, None
        self._link.restart(self._origin_ns(episode))

    def _new(self, episode: int) -> LinkDirection:
        origin_ns, stream = self._origin_ns(episode), self._stream
        return LinkDirection(self.profile, self._seed, self._uplink, origin_ns, stream=stream)

    def _origin_ns(self, episode: int) -> int:
        return -self._start(episode) if self._start else 0

    def _independent(self, conditions: Conditions, episode: int, first: int, count: int) -> Floats:
        """Compute the delays [s] of packets with independent random numbers, shape (count,)."""
        start, end = first // BLOCK, -(-(first + count) // BLOCK)
        key = stream_key(self._seed, self._uplink, episode, KIND, self._stream)
        delays = np.empty((end - start) * BLOCK)
        for block in range(start, end, _CHUNK):
            many = min(_CHUNK, end - block)
            part = delays[(block - start) * BLOCK :][: many * BLOCK]
            part[:] = self._chunk(conditions, key, block, many)
        return delays[first - start * BLOCK :][:count]

    def _chunk(self, conditions: Conditions, key: StreamKey, block: int, many: int) -> Floats:
        """Compute the delays [s] of the packets of `many` blocks, shape (256 many,)."""
        profile, draw = self.profile, partial(uniforms_of, key, block=block, blocks=many)

        def delays_of(purpose: Purpose) -> Floats:
            # In these steps, each number is rounded as in `send`.
            if not conditions.jitter:
                return np.full(many * BLOCK, float(conditions.delay_ns))
            found = draw(purpose)
            found *= 2.0
            found -= 1.0
            found *= conditions.jitter * 1e9
            np.rint(found, out=found)
            found += conditions.delay_ns
            return np.maximum(found, 0.0, out=found)

        delays = delays_of(Purpose.DELAY)
        if profile.reorder:
            delays[draw(Purpose.REORDER) < profile.reorder] = 0.0
        if profile.duplicate:
            hit = draw(Purpose.DUPLICATE) < profile.duplicate
            delays[hit] = np.minimum(delays, delays_of(Purpose.COPY_DELAY))[hit]
        delays *= 1e-9
        for purpose, chance in (
            (Purpose.LOSS, conditions.loss),
            (Purpose.CORRUPT, profile.corrupt),
        ):
            if chance and isinstance(chance, float):
                delays[draw(purpose) < chance] = np.nan
        return delays


def _whole(**values: Any) -> Iterator[int]:
    """Yield each value as a whole number; raise a BadInputError for one that is none."""
    for name, value in values.items():
        with naming(name):
            yield COUNT.of(value)


def _to_ns(period: float) -> int:
    """Return the time between two packets [ns], given in seconds."""
    with naming("period", "the time between two packets"):
        return round(float(PERIOD.of(period)) * 1e9)


def _is_independent(profile: DirectionProfile, conditions: Conditions) -> bool:
    """Return whether a packet's delay is a simple function of random numbers of its own."""
    return (
        profile.distribution == "uniform"
        and not profile.correlation
        and not conditions.blackout
        and isinstance(conditions.loss, float)
    )
