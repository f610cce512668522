# SPDX-License-Identifier: Apache-2.0

"""Metrics of the pictures of the robot's camera: how old, how many, how good, how large."""

from __future__ import annotations

from functools import partial

import numpy as np

from cloudrc.results.metrics.age import Ages, describe, sawtooth
from cloudrc.results.metrics.flight import Array, Columns, Flight, add_measures, select
from cloudrc.results.record.columns import join


def frame_ages(flight: Flight) -> Ages:
    """Compute the age of the newest picture that cloud has, from the first one on."""
    shown, span_ns = flight.recording["/frame_shown"], flight.span_ns
    stamps_ns = shown["stamp_ns"]
    if span_ns is None or not len(stamps_ns) or stamps_ns[0] >= span_ns[1]:
        return Ages(*np.zeros((4, 0)))
    first_ns = max(span_ns[0], stamps_ns[0])
    edges_ns = np.unique(np.concatenate([stamps_ns, [first_ns, span_ns[1]]]))
    edges_ns = edges_ns[(edges_ns >= first_ns) & (edges_ns <= span_ns[1])]
    return sawtooth(edges_ns, stamps_ns, shown["taken_ns"])


def _age(name: str, flight: Flight) -> float | None:
    return describe(frame_ages(flight)).get(name)


def _shown(flight: Flight) -> tuple[Columns, Array] | None:
    """Return the pictures of a flight, and which of them were shown; None without any.

    Those of the end may still be under way, by the longest time that one needed.
    """
    sent, shown = flight.during("/frame"), flight.recording["/frame_shown"]
    found = join(*(each["epoch"] << 32 | each["number"] for each in (shown, sent)))[1]
    if flight.end_ns is None or not len(sent["stamp_ns"]):
        return None
    longest_ns = max(shown["stamp_ns"] - shown["taken_ns"], default=0)
    is_shown = np.zeros(len(sent["stamp_ns"]), bool)
    is_shown[found] = True
    early = sent["taken_ns"] <= flight.end_ns - longest_ns
    return select(sent, early), is_shown[early]


def _frames_shown(flight: Flight) -> float | None:
    found = _shown(flight)
    return float(found[1].mean()) if found is not None and len(found[1]) else None


def _frame_psnr(flight: Flight) -> float | None:
    found = _shown(flight)
    if found is None or not found[1].any():
        return None
    sent, is_shown = found
    return float(sent["psnr"][is_shown].mean())


def _video_kbit(flight: Flight) -> float | None:
    sizes = flight.during("/frame")["size"]
    if flight.span_ns is None or not len(sizes):
        return None
    begin_ns, end_ns = flight.span_ns
    return float(sizes.sum() * 8e6 / (end_ns - begin_ns))


def _late(flight: Flight) -> float | None:
    return flight.growth("frames_late") if len(flight.recording["/frame"]) else None


add_measures(
    *((f"frame_age_{name}", partial(_age, name)) for name in ("mean", "p99", "max")),
    ("frames_shown", _frames_shown),
    ("frame_psnr", _frame_psnr),
    ("video_kbit", _video_kbit),
    ("frames_late", _late),
)
