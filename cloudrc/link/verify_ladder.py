"""Which counts of losses are believed, for windows of any length: worked out before it is asked.

The exact chances of a few thousand packets take milliseconds, which no loop has to spare in flight.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, nan

from cloudrc.link.profile import Loss, mean_loss
from cloudrc.link.verify_expect import share_margin
from cloudrc.link.verify_judge import Row, Verdict
from cloudrc.link.verify_loss import bounds, plausible
from cloudrc.link.verify_plan import is_told
from cloudrc.link.verify_quantity import ALARM, MISS

_FIRST, _STEP = 500, 1.3


@dataclass(frozen=True, slots=True)
class _Rung:
    """For `count` packets: shares that are believed, and whether a true link is sure to be."""

    count: int
    low: float
    high: float
    decides: bool


class Ladder:
    """Judges one count."""

    def __init__(self, name: str, loss: Loss, needs: int) -> None:
        """Work out windows up to what is needed; takes some 100 ms if that is many.

        Args:
            name: Of the row.
            loss: What chance counts.
            needs: Packets that decide.
        """
        self._name, self._asked = name, mean_loss(loss)
        counts = [_FIRST]
        while counts[-1] < needs:
            counts.append(min(needs, ceil(counts[-1] * _STEP)))
        self._rungs = [_rung(loss, count) for count in counts]

    def row(self, found: int, count: int) -> Row:
        """Judge so many of `count` packets; a longer window than worked out is as good as that."""
        below = [rung for rung in self._rungs if rung.count <= count]
        share = found / count if count else nan
        if not below:
            return Row(self._name, "1", self._asked, nan, share, 0.0, 1.0, "open")
        rung = below[-1]
        inside = rung.low <= share <= rung.high
        verdict: Verdict = ("ok" if rung.decides else "open") if inside else "off"
        return Row(self._name, "1", self._asked, nan, share, rung.low, rung.high, verdict)


def _rung(loss: Loss, count: int) -> _Rung:
    asked, margin = [(count, loss)], share_margin(mean_loss(loss))
    allowed = bounds(asked, margin, MISS)
    decides = is_told(asked, allowed)
    if not decides:  # only what is far off can be told by so few
        allowed = plausible(asked, margin, ALARM)
    return _Rung(count, allowed.low / count, allowed.high / count, decides)
