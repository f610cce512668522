"""What drawn fates and heard ones differ by, judged: pairs of them come in, rows go out."""

from __future__ import annotations

from dataclasses import dataclass
from math import nan

import numpy as np

from cloudrc.link.profile import DirectionProfile, GilbertElliott, Loss
from cloudrc.link.verify_estimate import Frame, frame_of
from cloudrc.link.verify_expect import (
    DEVIATION_FLOOR,
    JITTER_SHARES,
    MEAN_FLOOR,
    MEAN_SHARE,
    share_margin,
)
from cloudrc.link.verify_judge import Row, Verdict
from cloudrc.link.verify_loss import chances
from cloudrc.link.verify_quantity import MISS, Z_MISS
from cloudrc.link.verify_reference import Flags, Floats, overtaken

FEWEST = 1000
"""Datagrams that are compared at least."""


@dataclass(frozen=True, slots=True)
class Pairs:
    """Datagrams in the order of their counters: what was drawn, and what was heard.

    Attributes:
        sent: When each left [s], since its time line began, shape (n,).
        heard: Delay [s], shape (n,); NaN if it did not arrive.
        drawn: Likewise.
        arrived: Whether it arrived, shape (n,).
        drawn_copies: How many copies should, shape (n,).
        copies: How many did, shape (n,).
    """

    sent: Floats
    heard: Floats
    drawn: Floats
    arrived: Flags
    drawn_copies: Floats
    copies: Floats

    @property
    def timed(self) -> Flags:
        """Which arrived, should have, and have a delay."""
        return np.isfinite(self.heard) & np.isfinite(self.drawn)


def judged(
    profile: DirectionProfile, pairs: Pairs, off: tuple[Floats, Floats] | None = None
) -> list[Row]:
    """Judge all that can be: without a shared clock neither delays nor their order.

    Args:
        profile: What is asked.
        pairs: At least FEWEST of them.
        off: What would be drawn if the jitter were off by its margin, less and more [s], shape
            (n,); None where that follows from what is drawn, as no datagram waits for others.
    """
    rows = [*_delay_rows(profile, pairs, off)] if pairs.timed.any() else []
    rows.append(_loss_row(profile, pairs))
    if pairs.timed.any():
        rows.append(_reordered_row(pairs))
    there = max(1, int(pairs.arrived.sum()))
    doubled = (pairs.drawn_copies > 1) & pairs.arrived
    asked, measured = float(doubled.sum()) / there, float((pairs.copies > 1).sum()) / there
    rows.append(_share_row("duplicated", asked, measured, there))
    return rows


def _delay_rows(
    profile: DirectionProfile, pairs: Pairs, off: tuple[Floats, Floats] | None
) -> list[Row]:
    """Judge mean and scatter of the delays.

    What the ends add is never negative, so that a link which is too quick is told from half its
    margin on, and one that is too slow not later than at its margin.
    """
    timed = pairs.timed
    heard, drawn = pairs.heard[timed], pairs.drawn[timed]
    rest = heard - drawn
    noise = Z_MISS * float(rest.std()) / len(rest) ** 0.5
    mean = float(drawn.mean())
    margin = max(MEAN_FLOOR, MEAN_SHARE * mean)
    low, high = mean - 0.5 * margin, mean + margin - noise
    rows = [_row("mean", "s", mean, float(heard.mean()), (low, high))]
    scatter = float(drawn.std())
    allowed = max(DEVIATION_FLOOR, JITTER_SHARES[0] * scatter)
    bounds = scatter - allowed, scatter + allowed
    rows.append(_row("deviation", "s", scatter, float(heard.std()), bounds))
    frame = frame_of(profile, pairs.sent)
    inside, place = frame.look(np.where(timed, pairs.drawn, 0.0), timed)
    spread = float(place[inside].std()) if inside.sum() > FEWEST // 4 else 0.0
    if spread > 0.0 and frame.unit > 0.0:
        rows.append(_jitter_row(pairs, (inside, place), frame, off))
    return rows


def _jitter_row(
    pairs: Pairs,
    middle: tuple[Flags, Floats],
    frame: Frame,
    off: tuple[Floats, Floats] | None,
) -> Row:
    """Judge jitter: how much of what was drawn is found again, where nothing else makes delays."""
    inside, place = middle
    drawn = place[inside] - place[inside].mean()

    def slope(delay: Floats) -> tuple[float, float]:
        # Those that did not meet their drawn fate are others' doing: clipped, they move little.
        rest = (delay - pairs.drawn)[inside] / frame.jitter[inside]
        rest = np.clip(rest - np.nanmedian(rest), -1.0, 1.0)
        rest = np.where(np.isnan(rest), 0.0, rest)
        return 1.0 + float((rest * drawn).sum() / (drawn**2).sum()), float(rest.std())

    found, scatter = slope(pairs.heard)
    share = JITTER_SHARES[0]
    least, most = (1.0 - share, 1.0 + share) if off is None else (slope(one)[0] for one in off)
    spread = float(drawn.std())
    noise = Z_MISS * scatter / (spread * len(drawn) ** 0.5)
    asked = spread * frame.unit
    bounds = asked * (least + noise), asked * (most - noise)
    return _row("middle", "s", asked, found * asked, bounds)


def _loss_row(profile: DirectionProfile, pairs: Pairs) -> Row:
    """Judge losses by those that were not drawn, and drawn ones that did not happen."""
    lost, count = ~pairs.arrived, len(pairs.arrived)
    drawn = ~np.isfinite(pairs.drawn)
    asked, measured = float(drawn.mean()), float(lost.mean())
    wrong = int((lost != drawn).sum())
    most = _mismatches(profile, count, share_margin(asked))
    verdict: Verdict = "open" if most < 0 else "ok" if wrong <= most else "off"
    share = max(0, most) / count
    low, high = max(0.0, asked - share), asked + share
    return Row("loss", "1", asked, nan, measured, low, high, verdict)


def _mismatches(profile: DirectionProfile, count: int, margin: float) -> int:
    """Say how many fates may differ of those of a link whose loss is as asked; -1: too few tell.

    A link that is off by the margin has at least as many wrong fates, in bursts like its losses.
    """
    bursts = [
        loss
        for loss in (profile.loss, *(change.loss for change in profile.changes))
        if isinstance(loss, GilbertElliott) and loss.bad_start and loss.loss_bad > margin
    ]
    wrong: Loss = margin
    if bursts:
        longest = min(bursts, key=lambda one: one.bad_end)
        end, bad = longest.bad_end, margin / longest.loss_bad
        wrong = GilbertElliott(min(1.0, end * bad / (1.0 - bad)), end, longest.loss_bad)
    below = np.cumsum(chances([(count, wrong)]))
    return int(np.searchsorted(below, MISS, side="right")) - 1


def _reordered_row(pairs: Pairs) -> Row:
    def share(delay: Floats, lost: Flags) -> float:
        there = max(1, int((~lost).sum()))
        # To the microsecond: what was released at one instant has not overtaken.
        arrival = np.rint(np.where(lost, 0.0, pairs.sent + np.where(lost, 0.0, delay)) * 1e6)
        return float(overtaken(arrival, lost).sum()) / there

    lost, drawn = ~pairs.arrived, ~np.isfinite(pairs.drawn)
    count = int(pairs.arrived.sum())
    return _share_row("reordered", share(pairs.drawn, drawn), share(pairs.heard, lost), count)


def _share_row(name: str, asked: float, measured: float, count: int) -> Row:
    """Judge a share of what was compared one by one."""
    off = asked + share_margin(asked)
    margin = share_margin(asked) - Z_MISS * (off * max(0.0, 1.0 - off) / max(1, count)) ** 0.5
    return _row(name, "1", asked, measured, (max(0.0, asked - margin), asked + margin))


def _row(name: str, unit: str, asked: float, measured: float, allowed: tuple[float, float]) -> Row:
    low, high = allowed
    verdict: Verdict = "open" if low > high else "ok" if low <= measured <= high else "off"
    return Row(name, unit, asked, nan, measured, low, high, verdict)
