"""The verdict on one direction: what was asked, applied and measured, side by side.

A row is "ok" if it is proven to be within its margin, "off" if it is not although there were
probes enough, "open" if there were too few to say; "told" only says what else there is to know.
"""

from __future__ import annotations

from collections.abc import Iterator
from math import inf, isnan, nan
from typing import Literal, NamedTuple, TypeAlias

from cloudrc.link.profile import DirectionProfile
from cloudrc.link.verify_expect import Expectation, expect, share_margin
from cloudrc.link.verify_loss import Stretch, believed, bounds, mean_of, plausible
from cloudrc.link.verify_measure import Measured
from cloudrc.link.verify_plan import Plan, lost_of
from cloudrc.link.verify_quantity import ALARM, MISS, Quantity
from cloudrc.link.verify_rate import Trains

Verdict: TypeAlias = Literal["ok", "off", "open", "told"]


class Row(NamedTuple):
    """One quantity of one direction.

    Attributes:
        name: "mean", "deviation", "variation", "middle", "loss", "reordered", "duplicated",
            "corrupted" or "rate".
        unit: Of the numbers: "s", "1" or "bit/s".
        asked: What these probes measure on a true link [unit]; likewise all that follow.
        applied: What they measure on what the shaper says it does [unit]; NaN if it says nothing.
        measured: What they measured [unit].
        low: Least that is believed [unit].
        high: Most that is believed [unit].
        verdict: Of these numbers.
    """

    name: str
    unit: str
    asked: float
    applied: float
    measured: float
    low: float
    high: float
    verdict: Verdict


def judge(
    plan: Plan,
    measured: Measured,
    trains: Trains | None = None,
    applied: DirectionProfile | None = None,
) -> list[Row]:
    """Judge what was measured by what was asked.

    Args:
        plan: Of the probes that measured; more or fewer of them are judged likewise.
        measured: By them.
        trains: That measured the rate, if there is one.
        applied: What the shaper says it does; None if it says nothing.
    """
    asked = plan.expects
    said = _said(plan, applied)
    count = max(1, measured.sent)
    rows = [_delay_row("mean", asked.mean, said.mean if said else None, measured.mean, count)]
    rows.append(
        _delay_row(
            "deviation",
            asked.deviation,
            said.deviation if said else None,
            measured.deviation,
            count,
        )
    )
    for name in ("variation", "middle"):
        quantity: Quantity | None = getattr(asked, name)
        if quantity is not None:
            told = getattr(said, name) if said else None
            rows.append(_delay_row(name, quantity, told, getattr(measured, name), count))
    rows.append(_loss_row(plan, measured, applied))
    reordered = _delay_row(
        "reordered", asked.reordered, said.reordered if said else None, measured.reordered, count
    )
    rows.append(reordered._replace(unit="1"))
    rows += _marked_rows(plan, measured, applied)
    if trains is not None:
        rows.append(_rate_row(trains, measured, applied))
    return rows


def _said(plan: Plan, applied: DirectionProfile | None) -> Expectation | None:
    """What the probes measure on what the shaper says it does."""
    if applied is None:
        return None
    if applied == plan.profile:
        return plan.expects
    return expect(applied, plan.schedule)


def judge_quantity(name: str, asked: Quantity, measured: float, count: int) -> Row:
    """Judge one number that so many samples gave.

    Args:
        name: Of the row.
        asked: What is expected.
        measured: In the unit of what is expected [s].
        count: Samples.
    """
    return _delay_row(name, asked, None, measured, count)


def _delay_row(
    name: str, asked: Quantity, applied: Quantity | None, measured: float, count: int
) -> Row:
    slack, noise = asked.slack(count), asked.noise(count)
    enough = slack >= noise
    allowed = slack if enough else asked.margin + noise
    error = abs(measured - asked.expected)
    verdict: Verdict = "off"
    if isnan(measured):
        verdict = "open"
    elif error <= allowed:
        verdict = "ok" if enough else "open"
    low, high = max(0.0, asked.expected - allowed), asked.expected + allowed
    said = nan if applied is None else applied.expected
    return Row(name, "s", asked.expected, said, measured, low, high, verdict)


def _loss_row(plan: Plan, measured: Measured, applied: DirectionProfile | None) -> Row:
    stretches = _resized(plan.stretches, plan.schedule.count, measured.sent)
    said = nan if applied is None else lost_of(applied, plan.schedule)
    return _share_row("loss", stretches, measured.lost, said)


def _marked_rows(plan: Plan, measured: Measured, applied: DirectionProfile | None) -> Iterator[Row]:
    """Judge of those that arrived how many did so twice, and how many damaged."""
    for name, key, found in (
        ("duplicated", "duplicate", measured.doubled),
        ("corrupted", "corrupt", measured.damaged),
    ):
        marked: list[Stretch] = [(max(1, measured.arrived), getattr(plan.profile, key))]
        said = nan if applied is None else getattr(applied, key)
        yield _share_row(name, marked, found, said)


def _share_row(name: str, asked: list[Stretch], found: int, applied: float) -> Row:
    """Judge a count by its exact chances."""
    count, share = sum(packets for packets, _ in asked), mean_of(asked)
    margin = share_margin(share)
    verdict: Verdict = "ok"
    allowed = bounds(asked, margin, MISS)
    if believed(asked, allowed) < 1.0 - 2.0 * ALARM:
        # Too few: not even a true link would be believed. Only what is far off can be told.
        allowed, verdict = plausible(asked, margin, ALARM), "open"
    if not allowed.low <= found <= allowed.high:
        verdict = "off"
    low, high = allowed.low / count, allowed.high / count
    return Row(name, "1", share, applied, found / count, low, high, verdict)


def _rate_row(trains: Trains, measured: Measured, applied: DirectionProfile | None) -> Row:
    said = nan if applied is None else applied.rate or inf
    if not trains.judges:
        return Row("rate", "bit/s", trains.rate, said, nan, 0.0, inf, "open")
    span = _delay_row("rate", trains.span, None, measured.span, max(1, measured.trains))
    return Row(
        "rate",
        "bit/s",
        trains.rate,
        said,
        trains.measured(measured.span) if measured.trains else nan,
        trains.measured(span.high),
        trains.measured(span.low),
        span.verdict,
    )


def _resized(stretches: tuple[Stretch, ...], planned: int, sent: int) -> list[Stretch]:
    """Fit what was planned to what was sent."""
    if sent == planned or len(stretches) > 1:
        return list(stretches)
    return [(max(1, sent), stretches[0][1])]
