"""What is said beside the table of a verdict: how it was probed, and what was not judged."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from math import isfinite

from cloudrc.cli.link_verify_text import NAMES, NOT_JUDGED
from cloudrc.link.verify.causes import Findings
from cloudrc.link.verify.expect import DEVIATION_FLOOR, JITTER_SHARES, has_jitter
from cloudrc.link.verify.judge import SIZE, Trains
from cloudrc.link.verify.plan import LONGEST, Plan
from cloudrc.link.verify.standing import PERIOD


def shaper_in_words(findings: Mapping[str, Findings]) -> str:
    """Say who shapes both directions."""
    names = sorted({one.evidence.shaper for one in findings.values()})
    return f"shaped by {' and '.join(names)}"


def describe(plan: Plan, trains: Trains | None) -> str:
    """Say what is sent through a direction."""
    schedule = plan.schedule
    text = f"{schedule.count} probes of {schedule.size} bytes, {1 / schedule.period:.0f} per second"
    if trains and trains.count:
        text += f"; {trains.count} trains of {trains.length} x {SIZE} bytes"
    return text


def notes(way: str, plan: Plan, trains: Trains | None) -> Iterator[str]:
    """Say what is judged more loosely than usual, or not at all."""
    if not plan.enough:
        seconds = plan.needs * plan.schedule.period
        yield (
            f"{way}: its delays scatter so that {seconds:.0f} s of probes are needed (default: "
            f"at most {LONGEST:.0f}); give --seconds {seconds:.0f}"
        )
    if has_jitter(plan.profile):
        yield from on_jitter(way, plan.expects.share)
        expects = plan.expects
        if expects.share and expects.variation is None and expects.middle is None:
            yield from on_deviation(way, expects.deviation.expected)
    if trains and not trains.judges:
        yield f"{way}: rate {NOT_JUDGED}: it is too high to be told from none"


def on_jitter(way: str, share: float) -> Iterator[str]:
    """Say by which share [1] jitter may be off, unless it is the usual tenth."""
    usual = JITTER_SHARES[0]
    if not share:
        yield f"{way}: jitter {NOT_JUDGED}: too little of its delays' scatter is jitter"
    elif share > usual:
        yield f"{way}: jitter judged within {share:.0%} only: its tail hides {usual:.0%}"


def on_correlation(way: str, asked: float) -> Iterator[str]:
    """Say that netem makes nothing of a correlation [1], unless none was asked for."""
    if asked:
        yield f"{way}: correlation {asked:g} {NOT_JUDGED}: netem realises next to none of it"


def on_patience(way: str, name: str, needs: float) -> Iterator[str]:
    """Say that a quantity takes more datagrams than are kept.

    Args:
        way: The direction.
        name: Of the row.
        needs: Datagrams [1]; infinite if it cannot be told from what the ends add.
    """
    why = "what the ends may add hides it, however many datagrams there are"
    if isfinite(needs):
        why = f"takes {needs:.0f} datagrams, {needs * PERIOD:.0f} s of a flight"
    yield f"{way}: {NAMES.get(name, name)} {NOT_JUDGED}: {why}"


def on_deviation(way: str, asked: float) -> Iterator[str]:
    """Say that a standard deviation which alone judges the jitter is too small for a tenth.

    Args:
        way: The direction.
        asked: That deviation [s].
    """
    if 0.0 < asked < 2.0 * DEVIATION_FLOOR:
        yield (
            f"{way}: standard deviation, and so its jitter, judged within "
            f"{DEVIATION_FLOOR * 1e3:g} ms only: below {2e3 * DEVIATION_FLOOR:g} ms machines make "
            "as much"
        )
