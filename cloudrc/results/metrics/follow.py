# SPDX-License-Identifier: Apache-2.0

"""Judge by the truth whether a moving body stayed in the camera's view, and measure how well."""

from __future__ import annotations

import numpy as np

from cloudrc.base.rounding import exceeds
from cloudrc.results.metrics.flight import Array, Flight, add_measures, mean


def out_of_view(flight: Flight) -> Array:
    """Return for each row of /target_view in a flight whether the target was out of view."""
    view, follow = flight.during("/target_view"), flight.mission.follow
    if follow is None:
        return np.zeros(0, bool)
    near = view["distance"] <= follow.distance_max_m
    out: Array = ~(near & view["in_picture"].astype(bool))
    return out


def target_lost(flight: Flight) -> tuple[str, int] | None:
    """Return how long the target was out of view in words, and since when [ns]; None if it passes.

    It passes if no time without the target in view is longer than the mission allows.
    """
    out, follow = out_of_view(flight), flight.mission.follow
    if follow is None or not out.any():
        return None
    stamps_ns = flight.during("/target_view")["stamp_ns"]
    begins, ends = np.flatnonzero(np.diff(np.pad(out.astype(np.int8), 1))).reshape(-1, 2).T
    lasts = (stamps_ns[np.minimum(ends, len(out) - 1)] - stamps_ns[begins]) * 1e-9
    lost = np.flatnonzero([exceeds(each, follow.lost_after_s) for each in lasts.tolist()])
    if not lost.size:
        return None
    more = f", and {lost.size - 1} times more" if lost.size > 1 else ""
    limit = f"more than mission.follow.lost_after_s {follow.lost_after_s:g}"
    text = f"{follow.target} was out of view for {lasts[lost[0]]:.4g} s, {limit}{more}"
    return text, int(stamps_ns[begins[lost[0]]])


def _bearings(flight: Flight) -> Array:
    bearings: Array = flight.during("/target_view")["bearing"]
    return bearings


add_measures(
    ("out_of_view", lambda flight: mean(out_of_view(flight).astype(float))),
    ("bearing_error_rms", _bearings, "rms"),
)
