# SPDX-License-Identifier: Apache-2.0

"""Numbers of the ages in an episode's steps."""

from __future__ import annotations

from math import nan

import numpy as np

from cloudrc.link.draws import Floats


def describe_ages(name: str, ages: Floats, dt: float) -> dict[str, float]:
    """Return numbers of the ages [s] in successive steps of `dt` [s], shape (n,).

    A peak is the age in the last step before that of a fresher observation.
    """
    found = {"mean": nan, "p99": nan, "max": nan, "peak_mean": nan}
    if len(ages):
        *_, largest = ranked = sorted(ages.tolist())
        found |= {"mean": _mean(ages), "p99": _percentile(ranked, 0.99), "max": largest}
    peaks = ages[:-1][ages[1:] - ages[:-1] < dt - 1e-9]
    if len(peaks):
        found["peak_mean"] = _mean(peaks)
    numbers = {f"{name}_{part}": float(value) for part, value in found.items()}
    return {**numbers, f"{name}_of": len(ages)}


def _mean(values: Floats) -> float:
    """Return what `np.mean` returns, bit by bit, in half of its time."""
    total: float = np.add.reduce(values)
    return total / len(values)


def _percentile(ranked: list[float], share: float) -> float:
    """Return what `np.percentile` returns of numbers that rise, bit by bit, in less time."""
    place = (len(ranked) - 1) * share
    low = int(place)
    below, above = ranked[low], ranked[min(low + 1, len(ranked) - 1)]
    part, step = place - low, above - below
    return below + step * part if part < 0.5 else above - step * (1.0 - part)
