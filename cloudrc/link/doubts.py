"""Say in words which values of a link may be meant in another unit; they are used all the same."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from math import inf
from statistics import median

from cloudrc.link.profile import DirectionKeys, DirectionProfile, Trace, mean_loss

HEAVY = 0.5
"""Share of packets from which a value may be meant in percent [1]."""
VERBS = {"loss": "loses", "duplicate": "duplicates", "reorder": "reorders", "corrupt": "damages"}
"""Key that is a share of packets -> what the link does to them."""
PERIOD_MIN, PERIOD_MAX = 1e-4, 5.0
"""Usual time between two packets of a log or trace: from, to [s]."""
ROWS_MIN = 10
"""With fewer rows no trace is doubted, as a user may have typed them."""


def describe_heavy_shares(direction: DirectionKeys, name: str) -> Iterator[str]:
    """Warn in words of each share of packets of which 100 times less may be meant.

    `name` is "uplink" or "downlink".
    """
    for key, verb in VERBS.items():
        worst, when = getattr(direction, key), ""
        if key == "loss":
            worst, when = _worst_loss(direction)
        if worst >= HEAVY:
            yield (
                f"the {name} {verb} {worst * 100:.3g} % of its packets{when}: its {key} is a share "
                f"from 0 to 1, so 1 % is 0.01 (link.{name}.{key})"
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


def describe_period(period: float, column: str) -> str:
    """Warn in words of an unusual time between two packets, `period` [s]; "" if it is usual.

    `column` is the name of the column with the times.
    """
    if PERIOD_MIN <= period <= PERIOD_MAX:
        return ""
    return f"one packet in {period:.4g} s, if {column} is in the unit that its name says"


LATE_START = 5.0
"""Time of the first row of a trace from which the trace may be a piece of a longer one [s]."""


def describe_trace(trace: Trace | None) -> str:
    """Warn in words of unusual times of the rows of a trace; "" if they are usual."""
    if trace is None or len(trace.times) < ROWS_MIN:
        return ""
    if (start := trace.times[0]) > LATE_START:
        return (
            f"begins at {start:.4g} s, and its first row holds until then; subtract {start:.4g} "
            "from time_s if this is a piece of a longer trace"
        )
    return describe_period(median(b - a for a, b in pairwise(trace.times)), "time_s")
