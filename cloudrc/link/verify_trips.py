"""Round trips as cloud measures them: profiles of both directions come in, an expectation goes out.

Newest-wins passes on the faster datagrams of each direction, and cloud notes the newest round trip
once a period, so that it is not the sum of two mean delays. World applies a command with the next
tick of its simulation: by how much that rounds up depends on when cloud's periods begin in world's,
which nobody knows; jitter evens it out, and what it leaves is allowed for.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cloudrc.link.profile import DirectionProfile
from cloudrc.link.verify_ends import PERIOD
from cloudrc.link.verify_expect import MEAN_FLOOR, MEAN_SHARE
from cloudrc.link.verify_quantity import Quantity
from cloudrc.link.verify_reference import Floats, draw, instants

TICK = 2e-3
"""From one tick of world's simulation to the next [s]."""
_PHASES = [(tick + edge) * TICK for tick in range(round(PERIOD / TICK)) for edge in (0.01, 0.99)]
"""Beginnings of cloud's periods in world's that are tried: just after a tick, and before [s]."""
_SEED = 20250522
_RUNS, _COUNT, _BURN_IN = 48, 1000, 200


@dataclass(frozen=True, slots=True)
class Trips:
    """What is expected of round trips.

    Attributes:
        mean: Of theirs, where cloud's periods begin so that they are shortest, without what the
            ends add [s].
        rounding: How much longer they may be where cloud's periods begin otherwise [s].
        share: How many there are for each datagram [1].
    """

    mean: Quantity
    rounding: float
    share: float


def round_trips(up: DirectionProfile, down: DirectionProfile, size: int) -> Trips | None:
    """Expect of round trips: that of the newest command applied, echoed by the newest odometry.

    Args:
        up: What is asked of the uplink, which does not change.
        down: Of the downlink, likewise.
        size: Of a datagram, UDP payload [bytes].

    Returns:
        None if there are none: nothing passes.
    """
    rng = np.random.default_rng(_SEED)
    sent = instants(_COUNT, PERIOD)
    there = draw(up, sent, size, _RUNS, rng)
    back = draw(down, sent, size, _RUNS, rng)
    there_at = np.where(there.arrived, sent + there.delay, np.inf)
    back_at = np.where(back.arrived, sent + back.delay, np.inf)
    # The same chance for every phase: what differs is its doing.
    trips = [
        [_trips(there_at[run], back_at[run] + phase, sent, phase) for run in range(_RUNS)]
        for phase in _PHASES
    ]
    if not all(len(one) for runs in trips for one in runs):
        return None
    means = [float(np.concatenate(runs).mean()) for runs in trips]
    batches = np.array([[one.mean() for one in runs] for runs in trips])
    number = sum(len(one) for runs in trips for one in runs) / (_RUNS * len(_PHASES))
    spread = float(batches.std(axis=1).max()) * number**0.5
    residual = (batches - batches.mean(axis=1, keepdims=True)).ravel()
    deviation = float(residual.std())
    skew = float((residual**3).mean() / deviation**3) if deviation > 1e-9 else 0.0
    least, margin = min(means), max(MEAN_FLOOR, MEAN_SHARE * float(np.mean(means)))
    mean = Quantity(least, spread, skew, max(1, round(number)), margin)
    return Trips(mean, max(means) - least, number / (_COUNT - _BURN_IN))


def _trips(up: Floats, down: Floats, sent: Floats, phase: float) -> Floats:
    """Give the round trips [s] that cloud notes in one flight.

    Args:
        up: When each odometry arrives at cloud [s], shape (n,); infinite if it is lost.
        down: When each command arrives at world [s], likewise.
        sent: When each odometry leaves world [s], shape (n,); commands leave `phase` later.
        phase: When a period of cloud's begins, in one of world's [s].
    """
    applied = np.ceil(down / TICK - 1e-9) * TICK
    echoed = _newest(applied, sent)  # by each odometry
    # What leaves an orderly link at one instant comes in its order.
    used = up <= np.minimum.accumulate(np.append(up[1:], np.inf)[::-1])[::-1]
    chosen = np.flatnonzero(used & np.isfinite(up) & (echoed >= 0))
    fresh = chosen[np.append(True, np.diff(echoed[chosen]) > 0)] if len(chosen) else chosen
    period = np.ceil((up[fresh] - phase) / PERIOD - 1e-9)  # in which cloud notes it
    noted = fresh[np.append(np.diff(period) > 0, True)] if len(fresh) else fresh
    noted = noted[noted >= _BURN_IN]
    trips: Floats = (up[noted] - sent[noted]) + (applied - sent - phase)[echoed[noted]]
    return trips


def _newest(arrival: Floats, at: Floats) -> np.ndarray[tuple[int, ...], np.dtype[np.int64]]:
    """Say which is the newest that has arrived at each instant [s]; -1 if none has."""
    order = np.argsort(arrival, kind="stable")
    newest = np.maximum.accumulate(order)
    place = np.searchsorted(arrival[order], at + 1e-9, side="right") - 1
    return np.where(place >= 0, newest[np.maximum(place, 0)], -1)
