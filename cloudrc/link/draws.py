# SPDX-License-Identifier: Apache-2.0

"""Compute the random impairments of each packet with a counter-based random number generator.

Seed, direction, session (epoch) and kind of datagram select a stream of random numbers. The counter
of a packet is its position in the stream. So the impairment of a packet does not depend on earlier
calls. Each purpose, such as loss or jitter, has its own column of numbers, so that adding loss to a
profile does not change the jitter.

Loss bursts and correlated jitter depend on the previous packet. To limit the recursion, both
restart from their stationary distribution every 64 blocks of 256 packets.

The impairment of a packet is a tuple with one entry for each copy that arrives: no entry for a lost
packet, two entries for a duplicated packet. An entry is the extra delay from jitter and loss bursts
[ns], which may be negative, or OVERTAKES for a reordered packet, which skips queue and delay.
"""

from __future__ import annotations

from enum import IntEnum
from functools import lru_cache
from math import erf, erfc, sqrt

import numpy as np
from numpy.typing import NDArray

from cloudrc.link.profile import DirectionProfile, GilbertElliott, Loss

BLOCK = 256  # number of packets whose random numbers are generated together
CHAIN_BLOCKS = 64  # number of blocks after which bursts and correlated jitter restart
OVERTAKES = -(1 << 62)  # entry of a packet that skips both queue and delay (`reorder`)
PARETO_CUT = 1e-3  # probability of the tail that is cut off the Pareto distribution, in [0, 1]

_CACHED = 256
_PAGE = 4  # number of blocks whose uniform variates are drawn by one generator: making one is slow
_OUTPUTS_PER_COUNT = 4
_HALF_ROOT = sqrt(0.5)
# Moments of s^(-1/3) for s uniform in (cut, 1).
_PARETO_MEAN = 1.5 * (1.0 - PARETO_CUT ** (2 / 3)) / (1.0 - PARETO_CUT)
_PARETO_SQUARE = 3.0 * (1.0 - PARETO_CUT ** (1 / 3)) / (1.0 - PARETO_CUT)
_PARETO_DEVIATION = sqrt(_PARETO_SQUARE - _PARETO_MEAN**2)

Floats = NDArray[np.float64]
StreamKey = tuple[int, int]
Copies = tuple[int, ...]
"""A time [ns] for each copy of a packet that arrives; none if the packet is lost."""


class Purpose(IntEnum):
    """What a random number decides for a packet, such as its loss or its jitter."""

    DELAY = 0
    COPY_DELAY = 1
    LOSS = 2
    STATE = 3
    DUPLICATE = 4
    REORDER = 5
    CORRUPT = 6
    CORRUPT_BIT = 7
    RADIO = 8
    COPY_RADIO = 9


def stream_key(seed: int, uplink: bool, epoch: int, kind: int, stream: str = "") -> StreamKey:
    """Return the Philox key for the random numbers of a direction, session and kind of datagram.

    Links with one seed and different names, `stream`, have different random numbers.
    """
    from hashlib import blake2b  # takes milliseconds to import, as does `statistics`

    name = f"cloudrc link {seed} {'up' if uplink else 'down'} {epoch} {kind}"
    if stream:
        name += f" {stream}"
    digest = blake2b(name.encode(), digest_size=16).digest()
    return int.from_bytes(digest[:8], "little"), int.from_bytes(digest[8:], "little")


def uniforms(key: StreamKey, purpose: Purpose, block: int) -> Floats:
    """Draw independent uniform variates in (0, 1) for the packets of a block, shape (256,).

    Source: J. K. Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011: Philox
    4x64-10.
    """
    page, row = divmod(block, _PAGE)
    values: Floats = _page_of_uniforms(key, purpose, page)[row]
    return values


@lru_cache(maxsize=_CACHED)
def _page_of_uniforms(key: StreamKey, purpose: Purpose, page: int) -> Floats:
    values = uniforms_of(key, purpose, page * _PAGE, _PAGE)
    values.flags.writeable = False
    return values.reshape(_PAGE, BLOCK)


def uniforms_of(key: StreamKey, purpose: Purpose, block: int, blocks: int) -> Floats:
    """Draw what `uniforms` draws for each of `blocks` blocks from `block` on, in one array."""
    counter = np.array([block * (BLOCK // _OUTPUTS_PER_COUNT), 0, 0, purpose], dtype=np.uint64)
    generator = np.random.Philox(key=np.array(key, dtype=np.uint64), counter=counter)
    # 52 bits plus one half, so that the result is never 0 or 1.
    values = (generator.random_raw(blocks * BLOCK) >> np.uint64(12)).astype(np.float64)
    values += 0.5
    values *= 2.0**-52
    return values


@lru_cache(maxsize=_CACHED)
def normals(key: StreamKey, purpose: Purpose, block: int, correlation: float) -> tuple[float, ...]:
    """Draw standard normal variates for the packets of a block, shape (256,).

    Successive variates have the correlation c = `correlation`, in [0, 1]. The autoregression
    z_n = c · z_(n-1) + sqrt(1 - c²) · e_n keeps each variate exactly standard normal.

    Deviation: tc-netem mixes (1 - c) · new + c · old, which narrows the distribution.
    """
    from statistics import NormalDist

    fresh = map(NormalDist().inv_cdf, uniforms(key, purpose, block).tolist())
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
    """Simulate loss bursts for a block: True for each packet in the bad state, shape (256,).

    At each packet, the bad state starts with the probability `bad_start` or ends with the
    probability `bad_end`, both in [0, 1].
    """
    if not bad_start:
        return (False,) * BLOCK
    draws = iter(uniforms(key, Purpose.STATE, block).tolist())
    states = []
    if block % CHAIN_BLOCKS:
        bad = bad_states(key, block - 1, bad_start, bad_end)[-1]
    else:
        bad = next(draws) < bad_start / (bad_start + bad_end)  # the stationary share
        states.append(bad)
    for draw in draws:
        bad = draw >= bad_end if bad else draw < bad_start
        states.append(bad)
    return tuple(states)


def impairments(
    key: StreamKey, block: int, profile: DirectionProfile, jitter: float, loss: Loss
) -> list[Copies]:
    """Draw the impairments of the 256 packets of a block.

    `jitter` [s] and `loss` are arguments, because a profile can change them over time. A lost
    packet is neither duplicated nor reordered. The copy of a duplicated packet has its own
    random delay with the same distribution.

    Deviation: tc-netem delivers one copy of a packet that is both duplicated and lost.
    """
    offsets = _offsets(key, Purpose.DELAY, block, profile, jitter)
    table: list[Copies] = [(offset,) for offset in offsets]
    for n in _packets_hit(key, Purpose.REORDER, block, profile.reorder):
        table[n] = (OVERTAKES,)
    if profile.duplicate:
        copies = _offsets(key, Purpose.COPY_DELAY, block, profile, jitter)
        for n in _packets_hit(key, Purpose.DUPLICATE, block, profile.duplicate):
            table[n] = (*table[n], copies[n])
    if isinstance(loss, GilbertElliott):
        _lose_in_bursts(table, key, block, loss)
        return table
    for n in _packets_hit(key, Purpose.LOSS, block, loss):
        table[n] = ()
    return table


@lru_cache(maxsize=_CACHED)
def bit_flips(key: StreamKey, block: int, corrupt: float) -> dict[int, float]:
    """Select damaged packets at random: index in the block -> position of the flipped bit.

    The position is a share of the datagram's length, in [0, 1]. Each packet is damaged with the
    probability `corrupt`, in [0, 1].
    """
    places = uniforms(key, Purpose.CORRUPT_BIT, block)
    return {n: float(places[n]) for n in _packets_hit(key, Purpose.CORRUPT, block, corrupt)}


def shape(key: StreamKey, purpose: Purpose, block: int, profile: DirectionProfile) -> list[float]:
    """Draw jitter for a block in units of the profile's `jitter`, with mean 0, shape (256,).

    Uniform jitter is in (-1, 1); other jitter has standard deviation 1. Pareto jitter has exponent
    3 and is cut off at the 99.9 % quantile: it ranges from -0.69 to 12.1, with median -0.32.

    With a correlation c, the function transforms normal variates of correlation c. So the
    distribution stays exact, but the correlation of the jitter differs from c. For uniform jitter
    it is (6/π) · asin(c/2), at most 0.018 below c. For Pareto jitter it is 0.39 if c = 0.5.

    Source: tc-netem(8) for the meaning of jitter, iproute2 netem/pareto.c for the exponent.
    Deviation: netem cuts its Pareto table at 4, so its jitter has only 0.82 of the specified
    standard deviation.
    """
    correlation = 0.0 if purpose is Purpose.COPY_DELAY else profile.correlation
    if profile.distribution == "normal":
        return list(normals(key, purpose, block, correlation))
    # z: correlated normal variates; u: independent uniform variates. One of the two is empty.
    z = normals(key, purpose, block, correlation) if correlation else ()
    u = [] if correlation else uniforms(key, purpose, block).tolist()
    if profile.distribution == "uniform":
        return [erf(_HALF_ROOT * one) for one in z] or [2.0 * one - 1.0 for one in u]
    if profile.distribution == "table":
        shares = [0.5 * erfc(-_HALF_ROOT * one) for one in z] or u
        count = len(profile.quantiles)
        return [profile.quantiles[min(int(share * count), count - 1)] for share in shares]
    survival = [0.5 * erfc(_HALF_ROOT * one) for one in z] or [1.0 - one for one in u]
    kept = 1.0 - PARETO_CUT
    return [
        ((PARETO_CUT + kept * s) ** (-1 / 3) - _PARETO_MEAN) / _PARETO_DEVIATION for s in survival
    ]


def _offsets(
    key: StreamKey, purpose: Purpose, block: int, profile: DirectionProfile, jitter: float
) -> list[int]:
    if not jitter:
        return [0] * BLOCK
    scaled = jitter * 1e9 * np.array(shape(key, purpose, block, profile))
    offsets: list[int] = np.rint(scaled).astype(np.int64).tolist()
    return offsets


def _packets_hit(key: StreamKey, purpose: Purpose, block: int, chance: float) -> list[int]:
    if not chance:
        return []
    hit: list[int] = np.flatnonzero(uniforms(key, purpose, block) < chance).tolist()
    return hit


def _lose_in_bursts(table: list[Copies], key: StreamKey, block: int, loss: GilbertElliott) -> None:
    """Lose packets of a block in bursts; add `delay_bad_ms` to those that pass in the bad state."""
    extra = round(loss.delay_bad_ms * 1e-3 * 1e9)
    draws = uniforms(key, Purpose.LOSS, block).tolist()
    for n, bad in enumerate(bad_states(key, block, loss.bad_start, loss.bad_end)):
        if draws[n] < (loss.loss_bad if bad else loss.loss_good):
            table[n] = ()
        elif bad and extra:
            table[n] = tuple(entry + extra if entry != OVERTAKES else entry for entry in table[n])
