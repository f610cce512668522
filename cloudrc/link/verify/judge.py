"""The verdict on one direction: what was asked, applied and measured, side by side.

A row is "ok" if it is proven to be within its margin, "off" if it is not although there were
probes enough, "open" if there were too few to say; "told" only says what else there is to know.

The rate of a bottleneck, by trains of probes: how far a train is drawn out tells it.

A train of large packets leaves at once and waits at the bottleneck, which lets one through at a
time. Jitter draws it out as well, so what is expected comes from the reference, as for delays.

Source: M. Jain, C. Dovrolis, "Packet-dispersion techniques and a capacity-estimation methodology",
IEEE/ACM Trans. Networking 12, 2004.

Numbers of a link in a sentence: rows and values come in, words go out.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from math import ceil, inf, isnan, nan
from typing import Literal, NamedTuple, TypeAlias

import numpy as np

from cloudrc.link.profile import Change, DirectionProfile, Timeline
from cloudrc.link.verify.expect import Expectation, expect, share_margin
from cloudrc.link.verify.measure import Measured
from cloudrc.link.verify.plan import Plan, Stretch, believed, bounds, lost_of, mean_of, plausible
from cloudrc.link.verify.reference import ALARM, MISS, WIRE_BYTES, Floats, Quantity, draw, instants

SIZE = 1400
"""Of a packet in a train, UDP payload [bytes]: near the largest that is not cut on its way."""
RATE_SHARE = 0.25
"""By which share a rate may be off."""

_LENGTH_MAX, _LENGTH_MIN = 64, 4
_LONG_ENOUGH = 0.06
"""To draw a train out further [s] proves no more."""
_TRAINS_MAX, _TRAINS_MIN = 150, 8
_SENT_WITHIN = 2e-5
"""From one packet of a train to the next as they are sent [s]."""
_REST, _LONGEST = 0.03, 45.0
_RUNS = 1500
_SEED = 20250521


@dataclass(frozen=True, slots=True)
class Trains:
    """How to probe a bottleneck, and what to expect.

    Attributes:
        rate: Asked for [bit/s].
        length: Packets in a train.
        count: Trains.
        period: From one to the next [s].
        span: What the mean time from a train's first arrival to its last should be [s].
        judges: "rate" if one that is off by a quarter is told, "limit" if only whether there is
            any, "" if not even that: too fast for its jitter.
    """

    rate: float
    length: int
    count: int
    period: float
    span: Quantity
    judges: str

    @property
    def duration(self) -> float:
        """Time that it takes to send them [s]."""
        return self.count * self.period

    def measured(self, span: float) -> float:
        """Turn a mean span [s] into a rate [bit/s]: what jitter adds to it is as expected."""
        wire = (self.length - 1) * (SIZE + WIRE_BYTES) * 8.0
        drawn_out = span - (self.span.expected - wire / self.rate)
        return wire / drawn_out if drawn_out > 0.0 else inf


def plan_trains(profile: DirectionProfile, begin: float) -> Trains | None:
    """Choose trains for a direction that begin so long after the link came up [s].

    Returns:
        None if no rate is asked for then.
    """
    now = Timeline(profile).at(round(begin * 1e9))
    if now.rate is None:
        return None
    wire = (SIZE + WIRE_BYTES) * 8.0 / now.rate
    length = max(
        _LENGTH_MIN, min(_LENGTH_MAX, profile.queue_packets // 2, ceil(_LONG_ENOUGH / wire))
    )
    spans = _spans(profile, length, begin)
    rest = _REST + length * wire * 1.5 + 4.0 * float(spans.std())
    most = max(_TRAINS_MIN, min(_TRAINS_MAX, int(_LONGEST / rest)))
    mean = float(spans.mean())

    def margin(*factors: float) -> float:
        others = (_spans(_faster(profile, factor), length, begin).mean() for factor in factors)
        return float(min(abs(other - mean) for other in others))

    for judges, factors in (("rate", (1.0 - RATE_SHARE, 1.0 + RATE_SHARE)), ("limit", (0.5, inf))):
        span = _quantity(spans, margin(*factors))
        needs = max(_TRAINS_MIN, span.needs())
        if needs <= most:
            return Trains(now.rate, length, needs, rest, span, judges)
    return Trains(now.rate, length, 0, rest, _quantity(spans, inf), "")


def spans(sent: int, length: int, arrivals: Iterable[tuple[int, int]]) -> list[float]:
    """Say how far each train was drawn out [s].

    Args:
        sent: How many trains.
        length: Packets in each.
        arrivals: Number of the packet, counted through all trains, and when it arrived [ns].
    """
    first, last = [0] * sent, [0] * sent
    for number, at_ns in arrivals:
        train = number // length
        first[train] = min(first[train] or at_ns, at_ns)
        last[train] = max(last[train], at_ns)
    return [(b - a) * 1e-9 for a, b in zip(first, last, strict=True) if b > a > 0]


def _spans(profile: DirectionProfile, length: int, begin: float) -> Floats:
    sent = instants(length, _SENT_WITHIN, begin)
    fates = draw(profile, sent, SIZE, _RUNS, np.random.default_rng(_SEED))
    arrival = sent + fates.delay
    last = np.where(fates.arrived, arrival, -inf).max(axis=1)
    first = np.where(fates.arrived, arrival, inf).min(axis=1)
    drawn_out: Floats = last - first
    return drawn_out[np.isfinite(drawn_out) & (drawn_out > 0.0)]


def _quantity(spans: Floats, margin: float) -> Quantity:
    deviation, mean = float(spans.std()), float(spans.mean())
    skew = float(((spans - mean) ** 3).mean() / deviation**3) if deviation > 1e-7 else 0.0
    return Quantity(mean, deviation, skew, 1, margin)


def _faster(profile: DirectionProfile, factor: float) -> DirectionProfile:
    """Let all its rates be off by a factor; an infinite one has none."""

    def scaled(rate: float | None) -> float | None:
        return None if rate is None else (1e15 if factor == inf else factor * rate)

    changes: tuple[Change, ...] = tuple(
        replace(change, rate=scaled(change.rate)) for change in profile.changes
    )
    return replace(profile, rate=scaled(profile.rate), changes=changes)


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


def said(mean: Row, applied: DirectionProfile | None) -> str:
    """Say whether the shaper did what it was told, if it tells."""
    if applied is None or isnan(mean.applied):
        return ""
    # Clearly nearer: of a sample's mean and one in the long run either may be so by chance.
    if abs(mean.applied - mean.measured) < 0.5 * abs(mean.asked - mean.measured):
        return f"; the shaper says {ms(mean.applied)}: it was told so"
    return f"; the shaper says {ms(mean.applied)}"


def times(mean: Row) -> str:
    """Say how many times what was asked a mean is."""
    if not mean.asked:
        return f"the mean is {ms(mean.measured)}, none was asked for"
    return f"the mean is {ms(mean.measured)}, {mean.measured / mean.asked:.2f} times what was asked"


def ms(value: float) -> str:
    """Write a value [s] in milliseconds."""
    return f"{value * 1e3:.2f} ms"


def kbit(value: float) -> str:
    """Write a value [bit/s] in kbit/s."""
    return "no limit" if value > 1e12 else f"{value * 1e-3:.0f} kbit/s"
