"""What befalls each packet whatever the time: a stream's draws go in, delays to add come out.

The fate of a packet is a tuple with one entry per copy that arrives: () if it is lost, two entries
if it is duplicated. An entry is what jitter and the bad state add to the delay [ns], possibly
negative, or OVERTAKES.
"""

from __future__ import annotations

from functools import lru_cache
from math import erf, erfc, sqrt
from typing import TypeAlias

import numpy as np

from cloudrc.link.draws import BLOCK, Purpose, StreamKey, bad_states, normals, uniforms
from cloudrc.link.profile import DirectionProfile, GilbertElliott, Loss

OVERTAKES = -(1 << 62)
"""Less than minus any delay: the packet leaves at once."""

Fate: TypeAlias = tuple[int, ...]

PARETO_CUT = 1e-3
"""Share of the Pareto distribution that is cut off at its tail."""

# Moments of s^(-1/3) for s uniform in (cut, 1).
_PARETO_MEAN = 1.5 * (1.0 - PARETO_CUT ** (2 / 3)) / (1.0 - PARETO_CUT)
_PARETO_SQUARE = 3.0 * (1.0 - PARETO_CUT ** (1 / 3)) / (1.0 - PARETO_CUT)
_PARETO_DEVIATION = sqrt(_PARETO_SQUARE - _PARETO_MEAN**2)
_PARETO_REACH: float = (_PARETO_MEAN - 1.0) / _PARETO_DEVIATION
_NORMAL_REACH = 8.3
"""Of a quantile of the least number above 0 that can be drawn, 2**-54; with correlation no limit,
but one that would take some 10^15 packets to be passed."""
_HALF_ROOT = sqrt(0.5)


def fates(
    key: StreamKey, block: int, profile: DirectionProfile, jitter: float, loss: Loss
) -> list[Fate]:
    """Decide what befalls the 256 packets of a block.

    A packet that is lost is neither duplicated nor does it overtake. The copy of a packet has an
    independent delay of the same distribution.

    Deviation: in tc-netem a packet that is both duplicated and lost arrives once.

    Args:
        key: Stream.
        block: Number of the block.
        profile: Distribution, correlation, duplicate and reorder are taken from it.
        jitter: In force [s].
        loss: In force.

    Returns:
        Fates in the order of the counter, shape (256,).
    """
    offsets = _offsets(key, Purpose.DELAY, block, profile, jitter)
    table: list[Fate] = [(offset,) for offset in offsets]
    if profile.reorder:
        for n in _chosen(key, Purpose.REORDER, block, profile.reorder):
            table[n] = (OVERTAKES,)
    if profile.duplicate:
        copies = _offsets(key, Purpose.COPY_DELAY, block, profile, jitter)
        for n in _chosen(key, Purpose.DUPLICATE, block, profile.duplicate):
            table[n] = (*table[n], copies[n])
    if isinstance(loss, GilbertElliott):
        _lose_in_bursts(table, key, block, loss)
    elif loss:
        for n in _chosen(key, Purpose.LOSS, block, loss):
            table[n] = ()
    return table


@lru_cache(maxsize=256)
def bit_flips(key: StreamKey, block: int, corrupt: float) -> dict[int, float]:
    """Say which packets of a block are damaged, and where.

    Args:
        key: Stream.
        block: Number of the block.
        corrupt: Chance per packet, in [0, 1].

    Returns:
        Index in the block -> place of the flipped bit, as a share of the datagram in (0, 1).
    """
    places = uniforms(key, Purpose.CORRUPT_BIT, block)
    return {n: float(places[n]) for n in _chosen(key, Purpose.CORRUPT, block, corrupt)}


def shape(key: StreamKey, purpose: Purpose, block: int, profile: DirectionProfile) -> list[float]:
    """Draw the jitter of a block in units of `jitter`, with mean 0.

    uniform: in (-1, 1). normal: standard deviation 1. pareto: exponent 3, cut off at its 99.9 %
    quantile, then shifted and scaled to mean 0 and standard deviation 1; it starts at -0.69, has
    its median at -0.32, its 99 % quantile at 4.3 and ends at 12.1. (Uncut, it would now and then
    hold a packet for seconds, and with `keep_order` all that follow.) table: one of the profile's
    values, which have mean 0 and standard deviation 1.

    With a correlation c the variates are made from correlated normal ones, so that their
    distribution stays exact. c is then the correlation of those: that of the uniform variates is
    6/pi asin(c/2), less than c by at most 0.018; that of the Pareto variates 0.39 for c = 0.5 and
    0.86 for 0.9. Of a table's it depends on the table.

    Source: tc-netem(8) for the meaning of jitter, iproute2 netem/pareto.c for the exponent.
    Deviation: netem cuts its normal table off at +-4 and its Pareto table at 4, which leaves the
    latter 0.82 of the standard deviation asked for; here it is what was asked for.

    Args:
        key: Stream.
        purpose: Column.
        block: Number of the block.
        profile: Distribution and correlation are taken from it.

    Returns:
        Variates [1], shape (256,).
    """
    distribution, correlation = profile.distribution, profile.correlation
    if purpose is Purpose.COPY_DELAY:
        correlation = 0.0
    if distribution == "normal":
        return list(normals(key, purpose, block, correlation))
    if distribution == "uniform":
        if not correlation:
            drawn: list[float] = (2.0 * uniforms(key, purpose, block) - 1.0).tolist()
            return drawn
        return [erf(_HALF_ROOT * z) for z in normals(key, purpose, block, correlation)]
    if distribution == "table":
        return _from_table(key, purpose, block, profile.table, correlation)
    if correlation:
        correlated = normals(key, purpose, block, correlation)
        survival = [0.5 * erfc(_HALF_ROOT * z) for z in correlated]
    else:
        survival = [1.0 - u for u in uniforms(key, purpose, block).tolist()]
    kept = 1.0 - PARETO_CUT
    return [
        ((PARETO_CUT + kept * s) ** (-1 / 3) - _PARETO_MEAN) / _PARETO_DEVIATION for s in survival
    ]


def reach(profile: DirectionProfile) -> float:
    """Say how far below 0 the variates of `shape` can be [1]."""
    if profile.distribution == "table":
        return -min(profile.table)
    if profile.distribution == "uniform":
        return 1.0
    return _NORMAL_REACH if profile.distribution == "normal" else _PARETO_REACH


def _from_table(
    key: StreamKey, purpose: Purpose, block: int, table: tuple[float, ...], correlation: float
) -> list[float]:
    """Draw values of a table, each with equal chance; of correlated ones the ranks are alike."""
    shares: list[float] = uniforms(key, purpose, block).tolist()
    if correlation:
        shares = [0.5 * erfc(-_HALF_ROOT * z) for z in normals(key, purpose, block, correlation)]
    count = len(table)
    return [table[min(int(share * count), count - 1)] for share in shares]


def _offsets(
    key: StreamKey, purpose: Purpose, block: int, profile: DirectionProfile, jitter: float
) -> list[int]:
    """Scale the jitter of a block to [ns]."""
    if not jitter:
        return [0] * BLOCK
    scaled = jitter * 1e9 * np.array(shape(key, purpose, block, profile))
    offsets: list[int] = np.rint(scaled).astype(np.int64).tolist()
    return offsets


def _chosen(key: StreamKey, purpose: Purpose, block: int, chance: float) -> list[int]:
    """Say which packets of a block something with that chance happens to."""
    return [int(n) for n in np.flatnonzero(uniforms(key, purpose, block) < chance)]


def _lose_in_bursts(table: list[Fate], key: StreamKey, block: int, loss: GilbertElliott) -> None:
    """Lose and delay what the bad state meets."""
    extra = round(loss.delay_bad * 1e9)
    draws = uniforms(key, Purpose.LOSS, block).tolist()
    states = bad_states(key, block, loss.bad_start, loss.bad_end)
    for n, bad in enumerate(states):
        if draws[n] < (loss.loss_bad if bad else loss.loss_good):
            table[n] = ()
        elif bad and extra:
            table[n] = tuple(entry + extra if entry != OVERTAKES else entry for entry in table[n])
