# SPDX-License-Identifier: Apache-2.0

"""Compare the path of a flight with that of another one, however long each of them took."""

from __future__ import annotations

import numpy as np

from cloudrc.results.metrics.flight import Array, Flight

SAMPLE = 0.005
"""Distance of two samples along a path [m]."""
BLOCK = 1 << 20
"""Largest number of distances that are in memory at once."""


def path_of(flight: Flight) -> Array:
    """Sample the true path of the base every 5 mm of its length [m], shape (n, 3).

    A robot that waits adds no samples, so each part of the path counts by its length.
    """
    places = flight.truth["position"]
    if not len(places):
        return np.empty((0, 3))
    ways = np.linalg.norm(np.diff(places, axis=0), axis=1)
    along = np.concatenate(([0.0], np.cumsum(ways)))
    at = np.append(np.arange(0.0, along[-1], SAMPLE), along[-1])
    return np.stack([np.interp(at, along, axis) for axis in places.T], axis=1)


def rms_distance(path: Array, ideal: Array) -> float:
    """Return the RMS distance of the samples of `path` to the nearest point of `ideal` [m].

    Both are paths of `path_of`, with at least one sample. The nearest point is on one of the two
    straight lines beside the nearest sample.
    """
    squares = np.empty(len(path))
    size = max(1, BLOCK // len(ideal))
    for begin in range(0, len(path), size):
        rows = path[begin : begin + size]
        away = np.zeros((len(rows), len(ideal)))  # squared distances [m^2]
        for axis in range(3):
            away += np.square(np.subtract.outer(rows[:, axis], ideal[:, axis]))
        nearest = away.argmin(axis=1)
        least = np.square(rows - ideal[nearest]).sum(axis=1)
        for neighbour in (nearest - 1, nearest + 1):
            way = ideal[np.clip(neighbour, 0, len(ideal) - 1)] - ideal[nearest]
            since = rows - ideal[nearest]
            length = np.maximum(np.square(way).sum(axis=1), np.finfo(float).tiny)
            share = np.clip((since * way).sum(axis=1) / length, 0.0, 1.0)
            beside = np.square(since - share[:, None] * way).sum(axis=1)
            least = np.minimum(least, beside)
        squares[begin : begin + size] = least
    return float(np.sqrt(squares.mean()))
