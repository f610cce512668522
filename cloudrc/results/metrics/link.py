# SPDX-License-Identifier: Apache-2.0

"""Metrics of each direction of the link: delays, losses, late datagrams, and the relay's counters.

The mean delay includes datagrams that were too late to be used.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from cloudrc.results.metrics.counters import growth
from cloudrc.results.metrics.descriptions import RELAY_COUNTS, RELEASE_ERRORS, WAYS
from cloudrc.results.metrics.flight import Array, Flight, add_measures, select
from cloudrc.results.record.columns import Recording, datagrams, join
from cloudrc.wire.records import UNSENT

SENT = {"uplink": "/telemetry", "downlink": "/delay_estimate"}
"""Direction -> topic with one row for each datagram that is sent in this direction."""
SENDER = {"uplink": "world", "downlink": "cloud"}
"""Direction -> the end that sends in this direction."""
WINDOW_MAX = 1024
"""A missing datagram counts as lost after this number of newer datagrams; the receiver accepts
no older one, whether it is new or repeated (`cloudrc.wire.tunnel.window.WINDOW`)."""


def _late(flight: Flight, way: str) -> float | None:
    used = flight.during(f"/{way}_delay")["used"]
    return float(np.mean(~used.astype(bool))) if len(used) else None


def transit_ns(recording: Recording, way: str) -> int:
    """Return the longest time from sending to arrival of a datagram [ns]; 0 if none arrived.

    A datagram that is missing after this time counts as lost. If it was sent in this time before
    the end, the recording cannot tell whether it would still have arrived. So no datagram of this
    time counts, arrived or not. An offset between two clocks is in the result, as in all arrivals.
    """
    sent, arrivals = recording[SENT[way]], recording[f"/{way}_delay"]
    numbers, first = np.unique(datagrams(arrivals), return_index=True)
    rows, source = join(numbers, datagrams(sent))
    transits_ns = arrivals["stamp_ns"][first[rows]] - sent["stamp_ns"][source]
    return int(transits_ns.max()) if len(transits_ns) else 0


def loss(flight: Flight, way: str) -> float | None:
    """Compute the share of the datagrams sent during the flight that never arrived [1].

    Datagrams that may still arrive after the end of the recording do not count (`transit_ns`).
    """
    sent, arrivals = flight.during(SENT[way]), flight.recording[f"/{way}_delay"]
    world = flight.recording["/telemetry"]["stamp_ns"]
    if not len(world):
        return None
    before_ns = world[-1] - transit_ns(flight.recording, way)
    sent = select(sent, (sent["stamp_ns"] < before_ns) & (sent["counter"] != UNSENT))
    expected = accepted = 0
    for epoch in np.unique(sent["epoch"]):
        counters = sent["counter"][sent["epoch"] == epoch]
        first, last = counters.min(), counters.max()
        arrived = arrivals["counter"][arrivals["epoch"] == epoch]
        arrived = arrived[(arrived >= first) & (arrived <= last)]
        accepted += count_accepted(arrived, int(first))
        expected += int(last - first) + 1
    return (expected - accepted) / expected if expected else None


def count_accepted(arrived: Array, first: int) -> int:
    """Count the datagrams that a receiver accepts, each once.

    `arrived` are their counters in the order of arrival [1], shape (n,), `first` is the first sent.
    """
    newest = np.maximum.accumulate(np.append(first - 1, arrived))[:-1]
    return len(np.unique(arrived[arrived > newest - WINDOW_MAX]))


def _sent(flight: Flight, way: str, name: str) -> float | None:
    """Return by how much the sender's counter `name` rose in the flight [1]."""
    if flight.span_ns is None:
        return None
    return growth(flight.recording, name, flight.span_ns, end=SENDER[way], steady=True)


def _release_error(flight: Flight, way: str, name: str) -> float | None:
    """Return the last total of the relay's release error `name`, such as "p99" [s]."""
    count = flight.recording["/count"]
    totals = count["total"][count["name"] == f"{way}_release_error_{name}_ns"]
    return float(totals[-1]) * 1e-9 if len(totals) else None


def _delays(flight: Flight, way: str) -> Array:
    return flight.during(f"/{way}_delay")["delay"]


for _way in WAYS:
    add_measures(
        (f"{_way}_delay_mean", partial(_delays, way=_way), "mean"),
        (f"packets_sent_{_way}", partial(_sent, way=_way, name="sent")),
        (f"bytes_sent_{_way}", partial(_sent, way=_way, name="sent_bytes")),
        (f"late_{_way}", partial(_late, way=_way)),
        (f"loss_{_way}", partial(loss, way=_way)),
        *(
            (f"release_error_{name}_{_way}", partial(_release_error, way=_way, name=name))
            for name in RELEASE_ERRORS
        ),
        *(
            (f"{name}_{_way}", partial(Flight.growth, name=f"{_way}_{name.removeprefix('relay_')}"))
            for name in RELAY_COUNTS
        ),
    )
