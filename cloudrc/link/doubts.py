"""Say in words which values of a link may be meant in another unit; they are used all the same."""

from __future__ import annotations

from collections.abc import Iterator
from math import inf

from cloudrc.link.profile import DirectionKeys, DirectionProfile, Trace, mean_loss

HEAVY = 0.5
"""Share of lost packets from which a loss may be meant in percent [1]."""
ROWS_MIN = 10
"""With fewer rows no trace is doubted, as a user may have typed them."""


def describe_heavy_loss(direction: DirectionKeys, name: str) -> Iterator[str]:
    """Warn in words of a loss of which 100 times less may be meant.

    `name` is "uplink" or "downlink".
    """
    worst, when = _worst_loss(direction)
    if worst >= HEAVY:
        yield (
            f"the {name} loses {worst * 100:.3g} % of its packets{when}: its loss is a share from "
            f"0 to 1, so 1 % is 0.01 (link.{name}.loss)"
        )


def _worst_loss(direction: DirectionKeys) -> tuple[float, str]:
    """Return the largest share of packets that are lost in the long run, and when in words."""
    first, later = mean_loss(direction.loss), [c.loss for c in direction.changes if c.loss]
    if isinstance(direction, DirectionProfile) and direction.rows and direction.rows.losses:
        first = sum(direction.rows.losses) / len(direction.rows.losses)
    worst = max([first, *map(mean_loss, later)])
    return worst, " at times" * (worst > first)


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


LATE_START = 5.0
"""Time of the first row of a trace from which the trace may be a piece of a longer one [s]."""


def describe_trace(trace: Trace | None) -> str:
    """Warn in words of a trace whose first row comes late; "" if it does not."""
    if trace is None or len(trace.times) < ROWS_MIN or (start := trace.times[0]) <= LATE_START:
        return ""
    return (
        f"begins at {start:.4g} s, and its first row holds until then; subtract {start:.4g} "
        "from time_s if this is a piece of a longer trace"
    )
