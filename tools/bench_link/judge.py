"""A flow against the model: what came, when and in which order, and what should have."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from cloudrc.link.model import LinkDirection
from cloudrc.link.profile import DirectionProfile
from cloudrc.tunnel.codec import Kind
from tools.bench_link.flow import EPOCH, SIZE, Flow

Array: TypeAlias = NDArray[np.float64]

TIE_NS = 5_000
"""Which of two comes first is chance if they are due so close together [ns]."""


@dataclass(frozen=True)
class Judged:
    """A flow beside the sequence that the model draws for it.

    Attributes:
        errors: Measured minus drawn delay of each datagram that arrived [s], shape (n,).
        measured: Its delay [s], shape (n,).
        drawn: Its delay as drawn [s], shape (n,).
        sent: When it was sent, since the first one [s], shape (n,).
        wrongly_lost: Datagrams that should have come and did not, copies counted.
        wrongly_arrived: Datagrams that should not have come, copies counted.
        swapped: Neighbours in the order of arrival that should have come the other way round.
    """

    errors: Array
    measured: Array
    drawn: Array
    sent: Array
    wrongly_lost: int
    wrongly_arrived: int
    swapped: int


def judge(flow: Flow, profile: DirectionProfile, seed: int, origin_ns: int) -> Judged:
    """Compare.

    Args:
        flow: Measured.
        profile: Of the direction.
        seed: Of the experiment.
        origin_ns: When the relay saw its first datagram [ns], wall clock.

    Returns:
        Everything that there is to say.
    """
    model = LinkDirection(profile, seed, flow.uplink, origin_ns)
    kind = Kind.TELEMETRY if flow.uplink else Kind.COMMAND
    due: dict[int, list[int]] = {}
    for number in sorted(flow.sent):
        releases = model.send(EPOCH, kind, number, SIZE, flow.sent[number])
        due[number] = sorted(releases, reverse=True)
    rows, order, too_many = [], [], 0
    start_ns = min(flow.sent.values())
    for at_ns, number in flow.arrived:
        if not due[number]:
            too_many += 1
            continue
        due_ns, sent_ns = due[number].pop(), flow.sent[number]
        order.append(due_ns)
        rows.append((at_ns - due_ns, at_ns - sent_ns, due_ns - sent_ns, sent_ns - start_ns))
    errors, measured, drawn, sent = np.array(rows, dtype=float).reshape(-1, 4).T * 1e-9
    swapped = sum(a > b + TIE_NS for a, b in pairwise(order))
    missing = sum(map(len, due.values()))
    return Judged(errors, measured, drawn, sent, missing, too_many, swapped)
