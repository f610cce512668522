# SPDX-License-Identifier: Apache-2.0

"""How long packets wait for a medium, by queueing theory."""

from __future__ import annotations

from math import inf, lgamma

import numpy as np


def nddd1(senders: int, period: float, service: float) -> float:
    """Return the mean wait [s] of packets of periodic senders with random phases (N·D/D/1).

    Each of the `senders` sends a packet per `period` [s]; serving one takes `service` [s]. Infinite
    if they send more than can be served.

    Source: J. Roberts, J. Virtamo, "The superposition of periodic cell arrival streams in an ATM
    multiplexer", IEEE Trans. Commun. 39, 1991.
    """
    others, length = senders - 1, period / service  # in units of the service time
    if senders > length:
        return inf
    waits = np.linspace(0.0, senders, 50 * senders + 1)
    beyond = np.zeros_like(waits)  # chance to wait longer
    for count in range(1, others + 1):
        x = waits[waits < count]
        share = (count - x) / length
        ways = lgamma(others + 1) - lgamma(count + 1) - lgamma(others - count + 1)
        chance = np.exp(ways + count * np.log(share) + (others - count) * np.log1p(-share))
        beyond[: len(x)] += chance * (length - others + x) / (length - count + x)
    beyond = np.minimum(beyond, 1.0)
    return float(np.sum(beyond[1:] + beyond[:-1]) / 2 * (waits[1] - waits[0])) * service


def md1(load: float, service: float) -> float:
    """Return the mean wait [s] of packets that come at random (M/D/1).

    `load` is the share of time [1] in which the medium is busy, `service` that of a packet [s].
    """
    return inf if load >= 1.0 else load / (2.0 * (1.0 - load)) * service
