# SPDX-License-Identifier: Apache-2.0

"""Say in words what makes a link useless: no packet arrives, or its rate is too low."""

from __future__ import annotations

from collections.abc import Iterator
from math import inf

from cloudrc.link.profile import DirectionKeys, mean_loss

HEAVY = 0.99  # share of lost packets above which nothing can be controlled [1]


def describe_heavy_loss(direction: DirectionKeys, name: str) -> Iterator[str]:
    """Warn in words of a direction in which no packet arrives; `name` is that of the direction."""
    first, later = mean_loss(direction.loss), [c.loss for c in direction.changes if c.loss]
    worst = max([first, *map(mean_loss, later)])
    if worst >= HEAVY:
        when = " at times" * (worst > first)
        yield (
            f"the {name} loses {worst * 100:.3g} % of its packets{when}: its loss is a share from "
            f"0 to 1, so 1 % is 0.01 (link.{name}.loss)"
        )


def describe_low_rate(direction: DirectionKeys, name: str, needed: float, what: str) -> str:
    """Warn in words of a bottleneck that is slower than `what` needs; "" if there is none.

    `needed` is the rate of `what` [bit/s], `name` is "uplink" or "downlink".
    """
    first = direction.rate_kbit
    rates = [rate for rate in (first, *(c.rate_kbit for c in direction.changes)) if rate]
    lowest = min(rates, default=inf)
    if lowest * 1e3 >= needed:
        return ""
    when = " at times" * (lowest != first)
    return (
        f"link.{name}.rate_kbit {lowest:g} is{when} below the {needed * 1e-3:.4g} kbit/s that "
        f"{what} needs, so its queue fills; give kbit/s"
    )
