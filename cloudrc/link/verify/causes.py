"""Why a link is not what was asked: rows that are off and what shapers say come in, causes go out.

What can be read (qdiscs, counters, release errors, the profile in force) goes before what can only
be concluded from the numbers.

What a shaper that does not get its CPU does to the numbers of a link, and what it cannot do.

What a shaper tells of itself, read back: its state, its metrics, the kernel's qdiscs.

Nothing is assumed: what cannot be read is not known.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import isnan, sqrt
from typing import Any, NamedTuple

from cloudrc.link.profile import DirectionProfile, GilbertElliott, Loss
from cloudrc.link.sidecar import Near, Told
from cloudrc.link.tc import stretch
from cloudrc.link.verify.judge import Row, kbit, ms, said, times

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
    return {row.name: row for row in _starved_beyond(are_off(rows), unread)}


def _starved_beyond(off: Mapping[str, Row], unread: float) -> Iterator[Row]:
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


LATE = 1.5e-3
"""A shaper whose 99th percentile of the release error is above this [s] does not get its CPU."""
PASSED_SHARE = 0.9
"""If the shaper has seen less than this share of what arrived, the rest goes another way."""
UNREAD_SHARE = 0.003
"""If it has left more than this share of what was sent unread, it does not get its CPU."""
THROTTLED_SHARE, CPU_PERIOD = 0.01, 0.1
"""Stopped in so few periods [1], of so long each [s], a shaper is as good as never stopped; what is
late is so by at most the root of the one times the other. Source: Linux,
Documentation/scheduler/sched-bwc.rst, cpu.cfs_period_us."""
_NOTHING = 0.15
"""Share of the delay asked for below which nothing shapes."""


@dataclass(frozen=True, slots=True)
class Evidence:
    """What the machine says about one direction's shaper.

    Attributes:
        shaper: "relay", "netem", "none" if it is known that there is none, "" if nothing is known.
        why: Why there is none, or this one, in the words of who chose it; "" if nobody says.
        interface: Over which the flow leaves; "" if that is not known.
        elsewhere: Interfaces that have a netem qdisc although the flow does not leave there.
        layers: Shapers that the flow passes, as far as they can be seen; None if unknown.
        applied: What is in force as the shaper tells it; None if it does not.
        sent: Datagrams that this end sent; None if not counted.
        passed: Those of them that the shaper has counted; None if it does not count.
        unread: Those that the kernel dropped since the shaper did not read them; None if unknown.
        late: 99th percentile of the shaper's release error [s]; None if it does not measure it.
        throttled: Share of the CPU's periods in which the shaper was stopped, in [0, 1]; None
            if unknown.
        restored: How often another program has removed or changed netem's qdisc.
    """

    shaper: str = ""
    why: str = ""
    interface: str = ""
    elsewhere: tuple[str, ...] = ()
    layers: int | None = None
    applied: DirectionProfile | None = None
    sent: int | None = None
    passed: int | None = None
    unread: int | None = None
    late: float | None = None
    throttled: float | None = None
    restored: int = 0


class Cause(NamedTuple):
    """One cause: a word for machines, a direction ("uplink", "downlink" or "both"), a sentence."""

    code: str
    way: str
    text: str


class Findings(NamedTuple):
    """What is known about one direction."""

    rows: Sequence[Row]
    evidence: Evidence


def find_causes(findings: Mapping[str, Findings]) -> list[Cause]:
    """Name what is wrong with a link; nothing if no row is off.

    Args:
        findings: By direction.
    """
    found = {way: _first(way, one) for way, one in findings.items() if are_off(one.rows)}
    silent = [
        way
        for way, cause in found.items()  # another program took it away
        if cause.code in _UNSHAPED and not findings[way].evidence.restored
    ]
    shaped = [way for way in findings if way not in silent]
    if len(silent) == 1 and shaped:
        way, other = silent[0], shaped[0]
        detail = found[way].text
        text = f"only the {other} is shaped: {detail}"
        found[way] = Cause("one_direction", way, text)
    # What a shaper without its CPU does is known: what is off beyond that is told, too.
    also = [_beyond(way, findings[way]) for way, one in found.items() if one.code == "throttled"]
    return _merged(found) + [cause for cause in also if cause is not None]


_UNSHAPED = ("no_qdisc", "wrong_interface", "no_sch_netem", "not_shaped")


def _merged(found: Mapping[str, Cause]) -> list[Cause]:
    """Say once what is true of both directions."""
    causes = list(found.values())
    if len(causes) == 2 and causes[0].code == causes[1].code:
        text = causes[0].text
        return [causes[0]._replace(way="both")] if text == causes[1].text else causes
    return causes


def _first(way: str, one: Findings) -> Cause:
    """Take the first explanation that holds."""
    off = are_off(one.rows)
    explanations = (
        _of_machine(one),
        _of_order(off),
        _of_delay(off, one.evidence.applied),
        _of_chance(off),
    )
    for explanation in explanations:
        for code, text in explanation:
            return Cause(code, way, text)
    names = " and ".join(off)
    return Cause("unexplained", way, f"{names}: not as asked, and nothing explains it")


def _beyond(way: str, one: Findings) -> Cause | None:
    """Explain what a shaper that does not get its CPU leaves unexplained."""
    evidence = one.evidence
    unread = (evidence.unread or 0) / evidence.sent if evidence.sent else 0.0
    off = beyond(one.rows, unread)
    for explanation in (_of_order(off), _of_delay(off, evidence.applied), _of_chance(off)):
        for code, text in explanation:
            return Cause(code, way, text)
    return None


def _of_machine(one: Findings) -> Iterator[tuple[str, str]]:
    """Look at what can be read."""
    evidence, rows = one.evidence, one.rows
    if evidence.shaper == "none":
        if "sch_netem" in evidence.why:
            yield "no_sch_netem", f"{evidence.why}; set link.mode=relay, which needs none"
        elif evidence.elsewhere:
            yield "wrong_interface", _wrong_interface(evidence)
        else:
            where = evidence.interface or "the interface that the flow leaves by"
            yield "no_qdisc", f"there is no qdisc of ours on {where}: nothing shapes the flow"
    if evidence.restored:
        times = f"{evidence.restored} times" if evidence.restored > 1 else "once"
        yield "no_qdisc", f"another program removed or changed the qdisc {times}"
    sent, passed, unread = evidence.sent, evidence.passed, evidence.unread
    if sent and unread is not None and unread > UNREAD_SHARE * sent:
        text = (
            f"the shaper had no time to read {unread} of {sent} datagrams: it does not get its CPU"
        )
        yield "throttled", f"{text}; raise its limit or take load off the machine"
    arrived = None if sent is None else round(sent * (1.0 - _lost_share(rows)))
    if arrived and passed is not None and passed < PASSED_SHARE * arrived:
        text = f"of {arrived} datagrams that arrived, {passed} passed the shaper"
        yield "bypassed", f"{text}: the others took another way"
    if evidence.layers is not None and evidence.layers > 1:
        yield "shaped_twice", f"the flow passes {evidence.layers} shapers: remove all but one"
    stopped = evidence.throttled or 0.0
    if stopped > THROTTLED_SHARE and may_be_lateness(rows, sqrt(stopped) * CPU_PERIOD):
        yield (
            "throttled",
            f"the shaper was stopped by its CPU limit in {stopped:.0%} of the periods: "
            "raise link.resources.limits.cpu",
        )
    if evidence.late is not None and evidence.late > LATE and may_be_lateness(rows, evidence.late):
        yield (
            "throttled",
            f"the shaper releases late, 1 % by more than {evidence.late * 1e3:.1f} ms: it does not "
            "get its CPU; raise its limit or take load off the machine",
        )


def _lost_share(rows: Sequence[Row]) -> float:
    return next((row.measured for row in rows if row.name == "loss"), 0.0)


def _wrong_interface(evidence: Evidence) -> str:
    there = " and ".join(evidence.elsewhere)
    return f"the flow leaves by {evidence.interface}, but the qdisc is on {there}"


def _of_order(off: Mapping[str, Row]) -> Iterator[tuple[str, str]]:
    """Order first: packets that may not overtake wait, which shifts their mean, too."""
    row = off.get("reordered")
    if row is None:
        return
    if row.measured < SHARE_KEPT * row.asked and not _unshaped(off):
        yield (
            "order_kept",
            f"{row.asked:.1%} of the packets should be overtaken, {row.measured:.1%} are: order is "
            "kept although reordering was asked for",
        )
    if row.asked < 0.01 and row.measured > row.asked:
        yield "order_broken", f"{row.measured:.1%} of the packets are overtaken, none should be"


def _unshaped(off: Mapping[str, Row]) -> bool:
    mean = off.get("mean")
    return mean is not None and mean.measured < _NOTHING * mean.asked


def _of_delay(
    off: Mapping[str, Row], applied: DirectionProfile | None
) -> Iterator[tuple[str, str]]:
    """Conclude from the delays."""
    mean = off.get("mean")
    if mean is not None and not isnan(mean.measured):
        told = said(mean, applied)
        ratio = mean.measured / mean.asked if mean.asked else 0.0
        if mean.measured < max(_NOTHING * mean.asked, 5e-4):
            yield "not_shaped", f"the mean is {ms(mean.measured)}: nothing shapes the flow{told}"
        if 1.8 < ratio < 2.2:
            yield "doubled_delay", f"{times(mean)}: it is shaped twice, or asked for twice{told}"
        if 0.45 < ratio < 0.55:
            text = f"{times(mean)}: a round trip was taken for one way{told}"
            yield "halved_delay", text
        if "rate" in off:
            yield from _of_rate(off)
        yield "wrong_delay", f"{times(mean)}{told}"
    if "rate" in off:
        yield from _of_rate(off)
    row = off.get("deviation") or off.get("variation") or off.get("middle")
    if row is not None:
        word = SCATTER[row.name]
        text = f"{word} {ms(row.measured)} instead of {ms(row.asked)}: another jitter"
        yield "wrong_jitter", text


def _of_rate(off: Mapping[str, Row]) -> Iterator[tuple[str, str]]:
    row = off["rate"]
    told = isnan(row.measured)
    rate = row.applied if told else row.measured
    text = f"{'the shaper says ' if told else ''}{kbit(rate)} instead of {kbit(row.asked)}"
    if rate > row.asked:
        yield "rate_ignored", f"{text}: the rate is ignored"
    else:
        yield "slow", f"{text}: something is slower"


def _of_chance(off: Mapping[str, Row]) -> Iterator[tuple[str, str]]:
    """Losses and copies."""
    row = off.get("loss")
    if row is not None:
        text = f"{row.measured:.2%} are lost, {row.asked:.2%} should be"
        if row.measured > 0.999:
            yield (
                "nothing_arrives",
                "not one probe arrives: is the route open, the other end there?",
            )
        if row.measured < 0.05 * row.asked:
            yield "no_loss", f"{text}: loss is not applied"
        elif row.measured < row.asked:
            yield "less_loss", text
        else:
            yield "more_loss", text
    for name, (code, word) in _MARKS.items():
        row = off.get(name)
        if row is not None:
            yield code, f"{row.measured:.2%} {word}, {row.asked:.2%} should"


_MARKS = {
    "duplicated": ("wrong_duplicates", "arrive twice"),
    "corrupted": ("wrong_corruption", "arrive damaged"),
    "reordered": ("wrong_order", "come overtaken"),
}


_IN_ORDER = 50e9
"""A rate above this [bit/s] is there to keep the order, and limits nothing."""
_SAMPLE = re.compile(r"^(?P<name>\w+)(?:\{(?P<labels>[^}]*)\})? (?P<value>\S+)$", re.MULTILINE)

Samples = Mapping[tuple[str, str], float]
"""Values of metrics by name and by their labels as they are written: 'outcome="lost"'."""


def samples(text: str) -> Samples:
    """Read Prometheus' text; values of any unit."""
    return {
        (found["name"], found["labels"] or ""): float(found["value"])
        for found in _SAMPLE.finditer(text)
    }


def shaper_of(found: Samples, way: str) -> str:
    """Say who shapes a direction by the link's metrics; "" if they do not tell."""
    for (name, labels), value in found.items():
        if name == "cloudrc_link_info" and f'direction="{way}"' in labels and value:
            match = re.search(r'shaper="(\w+)"', labels)
            return match[1] if match else ""
    return ""


def of_metrics(
    found: Samples, sent: int, evidence: Evidence, before: Samples | None = None
) -> Evidence:
    """Add to what is known what the link's metrics say.

    Args:
        found: After the last probe.
        sent: Datagrams that this end has sent.
        evidence: What is known so far.
        before: Before the first probe, of a link that was there already: of stops and of
            qdiscs put back only those since then tell of these probes.
    """

    def since(name: str) -> float:
        now, then = found.get((name, ""), 0.0), (before or {}).get((name, ""), 0.0)
        return now - then if now >= then else now  # a link that was restarted counts from 0

    # The relay counts what came in; netem what it sent on and what it dropped.
    received = found.get(("cloudrc_link_datagrams_total", 'outcome="received"'))
    if evidence.shaper == "netem":
        kinds = ("forwarded", "lost", "held")
        counts = [
            found.get(("cloudrc_link_datagrams_total", f'outcome="{kind}"')) for kind in kinds
        ]
        received = sum(count or 0.0 for count in counts)
    unread = found.get(("cloudrc_link_datagrams_total", 'outcome="unread"'))
    late = found.get(("cloudrc_link_release_error_seconds", 'percentile="99"'))
    periods = since("cloudrc_cpu_periods_total")
    share = since("cloudrc_cpu_throttled_periods_total") / periods if periods > 0 else None
    passed = None if received is None else int(received)
    missed = None if unread is None else int(unread)
    known = replace(evidence, sent=sent, passed=passed, unread=missed)
    restored = int(since("cloudrc_link_restored_total"))
    return replace(known, late=late, throttled=share, restored=restored)


Qdiscs = Mapping[str, Sequence[Mapping[str, Any]]]
"""Objects of `tc -s -j qdisc show`, by interface."""


def of_qdiscs(listed: Qdiscs, interface: str) -> Evidence:
    """Say what shapes a flow by the qdiscs of a network namespace.

    Args:
        listed: All of them.
        interface: Over which the flow leaves.
    """
    netems = {name: _netems(qdiscs) for name, qdiscs in listed.items()}
    here = netems.get(interface, [])
    elsewhere = tuple(name for name, found in netems.items() if found and name != interface)
    counts = [int(one.get("packets", 0)) + int(one.get("drops", 0)) for one in here]
    return Evidence(
        shaper="netem" if here else "none",
        interface=interface,
        elsewhere=elsewhere,
        layers=len(here) or None,
        passed=max(counts, default=None),
    )


def in_force(found: Evidence, listed: Qdiscs, told: Evidence) -> Evidence:
    """Join what the kernel says with what the shaper's process says of itself.

    Args:
        found: From `of_qdiscs`.
        listed: What that was made from.
        told: By the process: what it was asked to put in force.
    """
    qdiscs = _netems(listed.get(found.interface, []))
    applied = told.applied
    if applied is not None and qdiscs:
        applied = netem_profile(qdiscs[-1].get("options", {}), applied)
    return replace(
        found,
        why=told.why,
        applied=applied if qdiscs else None,
        sent=told.sent,
        throttled=told.throttled,
        restored=told.restored,
    )


def of_told(told: Told) -> Evidence:
    """Say what a link's process tells, of itself and of the kernel."""
    known = Evidence(told.shaper, told.why, layers=1, applied=told.applied)
    return with_near(known, told.near)


def with_near(told: Evidence, near: Near | None) -> Evidence:
    """Add to what a shaper tells of itself which netems are on the flow's way, if that is known."""
    if near is None:
        return told
    if told.shaper == "netem":
        return in_force(of_qdiscs(near.netems, near.interface), near.netems, told)
    way = {_TO_RELAY, near.interface}
    others = sum(len(near.netems.get(name, ())) for name in way)
    return replace(told, interface=near.interface, layers=1 + others)


_TO_RELAY = "lo"
"""Over which an end reaches the relay of its pod."""


def netem_profile(options: Mapping[str, Any], told: DirectionProfile) -> DirectionProfile:
    """Put the options of a netem, as tc prints them, in place of the numbers of a profile.

    Args:
        options: Times in [s], chances in [0, 1], rate in [byte/s]; what is not there is 0.
        told: Says what the options leave open: distribution, order, what changes later.
    """
    delay = options.get("delay", {})
    loss: Loss = float(options.get("loss-random", {}).get("loss", 0.0))
    chain = options.get("loss-gemodel")
    if chain:
        p, r, good, bad = (float(chain.get(key, 0.0)) for key in ("p", "r", "1-k", "1-h"))
        loss = GilbertElliott(p, r, bad, good)
    rate = 8.0 * float(options.get("rate", {}).get("rate", 0.0))
    return replace(
        told,
        delay=float(delay.get("delay", 0.0)),
        jitter=float(delay.get("jitter", 0.0)) / stretch(told),
        loss=loss,
        duplicate=float(options.get("duplicate", {}).get("duplicate", 0.0)),
        reorder=float(options.get("reorder", {}).get("reorder", 0.0)),
        corrupt=float(options.get("corrupt", {}).get("corrupt", 0.0)),
        rate=rate if 0.0 < rate < _IN_ORDER else None,
        keep_order=rate > 0.0,
    )


def _netems(qdiscs: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    return [one for one in qdiscs if one.get("kind") == "netem"]
