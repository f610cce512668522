"""What a shaper that does not get its CPU does to the numbers of a link, and what it cannot do."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from cloudrc.link.verify_judge import Row

SCATTER = {
    "deviation": "standard deviation",
    "variation": "variation",
    "middle": "deviation in the middle",
}
"""Rows that tell of the jitter, in words."""
SHARE_KEPT = 0.2
"""If less than this share of what should be overtaken is, order is kept."""
_RATE_TIMES = 4.0
"""Trains whose ends were left unread seem quicker than their bottleneck, though not so many times:
three packets of four would have to be missing [1]."""


def are_off(rows: Sequence[Row]) -> dict[str, Row]:
    """Choose what is not as asked, by name."""
    return {row.name: row for row in rows if row.verdict == "off"}


def may_be_lateness(rows: Sequence[Row], late: float) -> bool:
    """Say whether releases so late [s] may explain what is off: delays, and not by more."""
    off, found = are_off(rows), {row.name: row for row in rows}
    if not {"mean", "deviation"} <= found.keys():
        return False
    mean, deviation = found["mean"], found["deviation"]
    by = mean.measured - mean.asked
    if by > late or ("mean" in off and by < 0.0):
        return False
    if "rate" in off and off["rate"].measured > off["rate"].asked:
        return False
    spread = deviation.measured**2 - deviation.asked**2
    if spread > late**2 or ("deviation" in off and spread < 0.0):
        return False
    return any(name in off for name in ("mean", "rate", *SCATTER))


def beyond(rows: Sequence[Row], unread: float) -> Mapping[str, Row]:
    """Choose what is off although nothing is known of a shaper but that it lacks its CPU.

    It adds delay and scatter, and losses as many as it left unread; it takes none away. It puts
    nothing in order either: fewer packets overtake only as fewer are there.

    Args:
        rows: Of one direction.
        unread: Share of what was sent that the shaper had no time to read, in [0, 1].

    Returns:
        Rows by name, losses but for those.
    """
    return {row.name: row for row in _beyond(are_off(rows), unread)}


def _beyond(off: Mapping[str, Row], unread: float) -> Iterator[Row]:
    for name, row in off.items():
        if name == "loss":
            if row.measured < row.low:
                yield row
            elif row.measured - unread > row.high:
                yield row._replace(measured=row.measured - unread)
        elif name == "reordered":
            if row.measured < SHARE_KEPT * (1.0 - unread) * row.asked:
                yield row
        elif name == "rate":
            if row.measured > _RATE_TIMES * row.asked:
                yield row
        elif name in ("mean", "deviation"):
            if row.measured < row.asked:
                yield row
        elif name in ("duplicated", "corrupted"):
            yield row
