"""Chance on the link: a stream, a purpose and a block of packets go in, their draws come out.

Everything here is a pure function, cached only to be fast. Seed, direction, epoch and kind of
datagram name a stream, the packet's counter its place in it, so that what befalls a packet depends
on nothing that was asked before. Draws are made for blocks of 256 packets, one column per purpose:
a purpose that a profile does not use costs nothing and shifts nothing.

A state that is handed from packet to packet (burst, correlation) starts anew from its stationary
distribution every 64 blocks (16,384 packets, 164 s at 100 Hz). That bounds the work for a counter
from anywhere, a forged one included, at the price of one broken link of the chain in 16,384.
"""

from __future__ import annotations

from enum import IntEnum
from functools import lru_cache
from hashlib import blake2b
from math import sqrt
from statistics import NormalDist
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

BLOCK = 256
"""Packets whose draws are made at once."""
BLOCK_BITS = 8
CHAIN_BLOCKS = 64
"""Blocks after which states start anew."""

_CACHED = 256
_OUTPUTS_PER_COUNT = 4
_NORMAL_QUANTILE = NormalDist().inv_cdf

StreamKey: TypeAlias = tuple[int, int]


class Purpose(IntEnum):
    """What a column of draws decides."""

    DELAY = 0
    COPY_DELAY = 1
    LOSS = 2
    STATE = 3
    DUPLICATE = 4
    REORDER = 5
    CORRUPT = 6
    CORRUPT_BIT = 7


def stream_key(seed: int, uplink: bool, epoch: int, kind: int) -> StreamKey:
    """Name the stream of one kind of datagram in one session and direction.

    Args:
        seed: Of the experiment.
        uplink: True for world to cloud.
        epoch: Of the session.
        kind: Message type in the header.

    Returns:
        Key of a Philox generator, two 64-bit words.
    """
    name = f"cloudrc link {seed} {'up' if uplink else 'down'} {epoch} {kind}"
    digest = blake2b(name.encode(), digest_size=16).digest()
    return int.from_bytes(digest[:8], "little"), int.from_bytes(digest[8:], "little")


@lru_cache(maxsize=_CACHED)
def uniforms(key: StreamKey, purpose: Purpose, block: int) -> NDArray[np.float64]:
    """Draw independent uniform variates for the 256 packets of a block.

    Source: J. K. Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011:
    Philox 4x64-10.

    Returns:
        Variates in the open interval (0, 1), read-only, shape (256,).
    """
    counter = np.array([block * (BLOCK // _OUTPUTS_PER_COUNT), 0, 0, purpose], dtype=np.uint64)
    generator = np.random.Philox(key=np.array(key, dtype=np.uint64), counter=counter)
    # 52 bits and a half, so that neither 0 nor 1 can come out.
    bits = generator.random_raw(BLOCK) >> np.uint64(12)
    values = (bits.astype(np.float64) + 0.5) * 2.0**-52
    values.flags.writeable = False
    return values


@lru_cache(maxsize=_CACHED)
def normals(key: StreamKey, purpose: Purpose, block: int, correlation: float) -> tuple[float, ...]:
    """Draw standard normal variates, each correlated with the one before.

    First-order autoregression z_n = c z_(n-1) + sqrt(1 - c^2) e_n, which leaves the marginal exact.

    Deviation: tc-netem mixes (1 - c) new + c old, which narrows the distribution.

    Args:
        key: Stream.
        purpose: Column.
        block: Number of the block.
        correlation: c in [0, 1].

    Returns:
        Shape (256,).
    """
    fresh = map(_NORMAL_QUANTILE, uniforms(key, purpose, block).tolist())
    if not correlation:
        return tuple(fresh)
    values = []
    if block % CHAIN_BLOCKS:
        value = normals(key, purpose, block - 1, correlation)[-1]
    else:
        value = next(fresh)
        values.append(value)
    innovation = sqrt(1.0 - correlation * correlation)
    for draw in fresh:
        value = correlation * value + innovation * draw
        values.append(value)
    return tuple(values)


@lru_cache(maxsize=_CACHED)
def bad_states(key: StreamKey, block: int, bad_start: float, bad_end: float) -> tuple[bool, ...]:
    """Run a two-state chain over the packets of a block.

    Args:
        key: Stream.
        block: Number of the block.
        bad_start: Chance per packet to turn bad, in [0, 1].
        bad_end: Chance per packet to turn good, in [0, 1].

    Returns:
        True where the packet meets the bad state, shape (256,).
    """
    draws = iter(uniforms(key, Purpose.STATE, block).tolist())
    states = []
    if block % CHAIN_BLOCKS:
        bad = bad_states(key, block - 1, bad_start, bad_end)[-1]
    else:
        # Stationary share of the bad state; a chain that never leaves the good one has none.
        bad = bad_start > 0.0 and next(draws) < bad_start / (bad_start + bad_end)
        states = [bad] if bad_start > 0.0 else []
    for draw in draws:
        bad = draw >= bad_end if bad else draw < bad_start
        states.append(bad)
    return tuple(states)
