"""Metrics of each direction of the link: delay, loss, late datagrams, and the relay's own counts.

The metrics include late datagrams, because the datagrams that the loop uses are only the fast ones.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from cloudrc.metrics.flight import Flight, add_metric, mean

WAYS = {"uplink": "from world to cloud", "downlink": "from cloud to world"}
"""Direction -> description of the direction in the meaning of a metric."""
SENT = {"uplink": "/telemetry", "downlink": "/delay_estimate"}
"""Direction -> topic with one row per datagram sent that way."""
SETTLING_NS = 2_000_000_000
"""Time after which a datagram that has not arrived counts as lost [ns]."""
PERCENTILES = {"p50": "median", "p99": "99th percentile", "p999": "99.9th percentile"}


def _delay_mean(flight: Flight, way: str) -> float | None:
    """Average the delay; None if the two ends could not prove that they share a clock."""
    return mean(flight.during(f"/{way}_delay")["delay"])


def _late(flight: Flight, way: str) -> float | None:
    used = flight.during(f"/{way}_delay")["used"]
    return float(np.mean(~used.astype(bool))) if len(used) else None


def loss(flight: Flight, way: str) -> float | None:
    """Compute the share of the datagrams sent during the flight that never arrived [1].

    Epoch and counter identify a datagram. Datagrams sent in the last SETTLING_NS of the recording
    may still arrive and do not count.
    """
    sent, arrivals = flight.during(SENT[way]), flight.recording[f"/{way}_delay"]
    world = flight.recording["/telemetry"]["stamp_ns"]
    if not len(world):
        return None
    settled = sent["stamp_ns"] <= world[-1] - SETTLING_NS
    keys = set(zip(sent["epoch"][settled], sent["counter"][settled], strict=True))
    arrived = keys.intersection(zip(arrivals["epoch"], arrivals["counter"], strict=True))
    return 1.0 - len(arrived) / len(keys) if keys else None


def _relay_count(flight: Flight, name: str, scale: float = 1.0) -> float | None:
    """Return the relay's last total of a count; None if no relay shaped the link."""
    count = flight.recording["/count"]
    totals = count["total"][count["name"] == name]
    return int(totals[-1]) * scale if len(totals) else None


for _way, _words in WAYS.items():
    _all = f"Mean one-way delay {_words} of all datagrams that arrived, late ones included."
    add_metric(f"{_way}_delay_mean", "s", _all, partial(_delay_mean, way=_way))
    for _name, _which, _measure in (
        ("late", f"arrived datagrams {_words} that were too late to be used.", _late),
        ("loss", f"datagrams {_words} that never arrived.", loss),
    ):
        add_metric(f"{_name}_{_way}", "1", f"Share of the {_which}", partial(_measure, way=_way))
    for _name, _which in PERCENTILES.items():
        add_metric(
            f"release_error_{_name}_{_way}",
            "s",
            f"Delay with which the relay released datagrams {_words} after they were due: "
            f"{_which}.",
            partial(_relay_count, name=f"{_way}_release_error_{_name}_ns", scale=1e-9),
        )
    for _name, _which in (
        ("relay_overflow", "that the relay dropped because its queue was full."),
        # The release errors do not include this time.
        ("relay_stalled", "that waited 50 ms or more until the relay read them."),
        ("released_early", "that left before they were due; above 0 the relay has a bug."),
    ):
        _count = f"{_way}_{_name.removeprefix('relay_')}"
        _last = partial(_relay_count, name=_count)
        add_metric(f"{_name}_{_way}", "1", f"Datagrams {_words} {_which}", _last)
