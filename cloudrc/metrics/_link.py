"""What the two directions of the link share: arrivals and counters go in, delays and loss come out.

A link is judged by all datagrams that arrive, the late ones included: those that the loop uses are
a selection of the quick ones.
"""

from __future__ import annotations

import numpy as np

from cloudrc.metrics._flight import Flight

SENT = {"/uplink_delay": "/telemetry", "/downlink_delay": "/delay_estimate"}
"""Topic of the arrivals -> topic with one row per datagram sent that way."""

SETTLING_NS = 2_000_000_000
"""How long a datagram may take before it is taken for lost [ns]."""


def late(flight: Flight, topic: str) -> float | None:
    """Share of the datagrams that arrived in one direction without being used [1]."""
    used = flight.during(topic)["used"]
    return float(np.mean(~used.astype(bool))) if len(used) else None


def loss(flight: Flight, topic: str) -> float | None:
    """Share of the datagrams sent in one direction during the flight that never arrived [1].

    By epoch and counter. Those of the recording's last seconds may still be on their way and do
    not count.
    """
    sent, arrivals = flight.during(SENT[topic]), flight.recording[topic]
    world = flight.recording["/telemetry"]["stamp_ns"]
    if not len(world):
        return None
    settled = sent["stamp_ns"] <= world[-1] - SETTLING_NS
    keys = set(zip(sent["epoch"][settled], sent["counter"][settled], strict=True))
    arrived = keys.intersection(zip(arrivals["epoch"], arrivals["counter"], strict=True))
    return 1.0 - len(arrived) / len(keys) if keys else None
