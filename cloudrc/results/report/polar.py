# SPDX-License-Identifier: Apache-2.0

"""Make the polar picture of the robot's scans, which moves with the replay of a report."""

from __future__ import annotations

import json
from importlib.resources import files
from string import Template
from typing import Any

import numpy as np

from cloudrc.results.metrics.flight import Flight, select, yaw_of
from cloudrc.results.metrics.perception import acted

SCANS_MAX = 3000
"""Largest number of scans in a page; of a longer flight every second, third, ... is left out."""


def write_polar(flight: Flight) -> str:
    """Return the picture as a section of an HTML page; "" for a flight without scans."""
    scans = flight.during("/scan")
    count = len(scans["stamp_ns"])
    if not count:
        return ""
    scans = select(scans, np.arange(0, count, -(-count // SCANS_MAX)))
    angles = scans["angle_min"][0] + scans["angle_increment"][0] * np.arange(
        scans["ranges"].shape[1]
    )
    goals = _goals(flight)
    seen, applied = acted(flight)
    taken_ns, acted_on_ns = seen["seen_stamp_ns"].tolist(), applied["stamp_ns"].tolist()
    ages = dict(zip(taken_ns, acted_on_ns, strict=True))
    shown: list[dict[str, Any]] = []
    for stamp_ns, ranges in zip(scans["stamp_ns"].tolist(), scans["ranges"], strict=True):
        acted_ns = ages.get(stamp_ns)
        shown.append({
            "time": round(float(flight.seconds(stamp_ns)), 3),
            "ranges": np.rint(np.where(np.isfinite(ranges), ranges * 1e3, 0)).astype(int).tolist(),
            "goal": goals.get(stamp_ns),
            "age": None if acted_ns is None else round((acted_ns - stamp_ns) * 1e-6),
        })  # fmt: skip
    reach = float(scans["range_max"][0])
    data = {"angles": np.round(angles, 5).tolist(), "reach": reach, "scans": shown}
    return Template(files(__package__).joinpath("polar.html").read_text("utf-8")).substitute(
        last=len(shown) - 1, data=json.dumps(data), duration=max(flight.duration, 1e-3)
    )


def _goals(flight: Flight) -> dict[int, list[float]]:
    """Return stamp of a scan [ns] -> setpoint that cloud made of it [m], ahead and to the left."""
    seen, truth = flight.during("/perception"), flight.truth
    rows = np.searchsorted(truth["stamp_ns"], seen["seen_stamp_ns"]).clip(
        max=len(truth["stamp_ns"]) - 1
    )
    offsets, yaws = (
        seen["position"] - truth["position"][rows],
        yaw_of(truth["orientation_wxyz"][rows]),
    )
    ahead = offsets[:, 0] * np.cos(yaws) + offsets[:, 1] * np.sin(yaws)
    left = offsets[:, 1] * np.cos(yaws) - offsets[:, 0] * np.sin(yaws)
    return {
        stamp_ns: [round(x, 3), round(y, 3)]
        for stamp_ns, x, y in zip(
            seen["seen_stamp_ns"].tolist(), ahead.tolist(), left.tolist(), strict=True
        )
        if x == x  # a perception may return no setpoint
    }
