# SPDX-License-Identifier: Apache-2.0

"""Name the likely cause if the measurements of a link differ from its profile.

Causes that the machine itself shows (by its qdiscs, its counters, or a late shaper) come before
causes that are only inferred from the measurements.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from math import inf, isnan
from typing import Any, NamedTuple

from cloudrc.base.outside.prometheus import Metrics, total
from cloudrc.link.verify.judge import Judgement

LATE, UNREAD, STOPPED = 1.5e-3, 0.003, 0.01
"""Limits of a shaper with enough CPU time: 99 % quantile of its release error [s]; share of
datagrams not read in time; share of CPU periods in which the shaper was throttled."""
RAISED = ("mean", "round_trip", "deviation", "loss")  # rise if the shaper lacks CPU time
PASSED = 0.9  # if the shaper counts less than this share of the arrived datagrams, some bypass it


class ShaperFacts(NamedTuple):
    """Facts about one direction's shaper, which its machine reports; None or "" means unknown."""

    shaper: str = ""  # "relay", "netem"; "none" if the interface has no netem qdisc
    why: str = ""  # why this shaper was chosen, in words
    interface: str = ""  # interface through which the flow leaves
    elsewhere: tuple[str, ...] = ()  # other interfaces that have a netem qdisc
    layers: int = 1  # number of shapers that the flow passes
    sent: int | None = None  # datagrams that world or cloud sent
    passed: int | None = None  # datagrams that the shaper counted
    starved: str = ""  # signs of a lack of CPU time; "" if there are none
    restored: int = 0  # times that another program removed or changed the qdisc


def read_evidence(
    page: Mapping[str, Any], metrics: Metrics, sent: int | None = None
) -> ShaperFacts:
    """Combine the page /link.json of a `link` container with its metrics.

    `sent` is the number of datagrams sent to the shaper since it started; None if unknown.
    """
    received, unread = (
        int(total(metrics, "cloudrc_link_datagrams_total", outcome=outcome))
        for outcome in ("received", "unread")
    )
    stopped = int(total(metrics, "cloudrc_cpu_throttled_periods_total"))
    periods = int(total(metrics, "cloudrc_cpu_periods_total"))
    late = total(metrics, "cloudrc_link_release_error_seconds", percentile="99")
    signs = (
        (unread > UNREAD * received, f"{unread} datagrams not read in time"),
        (late > LATE, f"1 % released later than {in_unit(late, 's')}"),
        (stopped > STOPPED * periods, f"stopped in {stopped} of {periods} CPU periods"),
    )
    shaper, interface = page.get("shaper", ""), page.get("interface", "")
    netems, netem = page.get("netems", {}), shaper == "netem"
    ways = {interface} if netem else {interface, "lo"}  # the relay receives through lo
    here = [one for way in ways for one in netems.get(way, ())]
    passed = received + unread if metrics and not netem else None
    if netem and here:
        passed = max(int(one.get("packets", 0)) + int(one.get("drops", 0)) for one in here)
    return ShaperFacts(
        shaper="none" if netem and "netems" in page and not here else shaper,
        why=page.get("reason", ""),
        interface=interface,
        elsewhere=tuple(sorted(netems.keys() - ways)) if netem else (),
        layers=len(here) if netem else 1 + len(here),
        sent=sent,
        passed=passed if sent is not None else None,
        starved=", ".join(text for holds, text in signs if holds),
        restored=int(total(metrics, "cloudrc_link_restored_total")),
    )


class LinkCause(NamedTuple):
    """One reason why a link differs from its profile."""

    code: str  # one word, for programs
    way: str  # "uplink", "downlink" or "both"
    text: str  # for people


class Findings(NamedTuple):
    """Judged measurements of one direction of the link, and facts about its shaper."""

    rows: Sequence[Judgement]
    evidence: ShaperFacts
    probes: str = ""  # which datagrams were measured, in words


def find_causes(findings: Mapping[str, Findings]) -> list[LinkCause]:
    """List why measurements of a link have the verdict "off"; return [] if none has it."""
    found = {way: list(_causes_of(one)) for way, one in findings.items()}
    silent = [way for way, causes in found.items() if causes and causes[0][0] in _UNSHAPED]
    shaped = [way for way in findings if way not in silent]
    if len(silent) == len(shaped) == 1 and not findings[silent[0]].evidence.restored:
        text = f"only the {shaped[0]} is shaped: {found[silent[0]][0][1]}"
        found[silent[0]] = [("one_direction", text)]
    if len({*map(tuple, found.values())}) == 1 < len(found):
        found = {"both": next(iter(found.values()))}
    return [LinkCause(code, way, text) for way, causes in found.items() for code, text in causes]


_UNSHAPED = ("no_qdisc", "wrong_interface", "no_sch_netem", "not_shaped")
_BY_NUMBERS = (
    ("not_shaped", "mean", 0.0, 0.15, ": nothing shapes the flow"),
    ("order_kept", "reordered", 0.0, 0.2, ": order is kept although reordering was requested"),
    ("order_broken", "reordered", 3.0, inf, ": order should be kept"),
    ("doubled_delay", "mean", 1.8, 2.2, ": it is shaped twice, or requested twice"),
    ("halved_delay", "mean", 0.45, 0.55, ": a round trip was taken for one way"),
    ("rate_ignored", "rate", 1.0, inf, ": the rate is ignored"),
    ("slow", "rate", 0.0, 1.0, ": the bottleneck is slower"),
    ("wrong_phase", "phase", 0.0, inf, ": packets take other slots of the radio"),
    ("wrong_delay", "mean", 0.0, inf, ""),
    ("wrong_delay", "round_trip", 0.0, inf, ""),
    ("wrong_jitter", "deviation", 0.0, inf, ": the jitter differs"),
    ("no_loss", "loss", 0.0, 0.05, ": loss is not applied"),
    ("less_loss", "loss", 0.0, 1.0, ""),
    ("more_loss", "loss", 1.0, inf, ""),
    ("wrong_duplicates", "duplicated", 0.0, inf, ""),
    ("wrong_order", "reordered", 0.0, inf, ""),
    ("wrong_distribution", "distribution", 0.0, inf, ": the delays have another distribution"),
)
"""Rules in the order of their certainty: code of the cause, quantity, smallest and largest ratio of
measured to requested value, and text."""


def _causes_of(one: Findings) -> Iterator[tuple[str, str]]:
    """Yield code and text of at most two reasons why quantities have the verdict "off".

    First comes the most certain cause that the machine's counters show. If there is no such cause,
    or if its code is "throttled", the most certain cause by the measured values comes next.
    """
    off = {row.name: row for row in one.rows if row.verdict == "off"}
    lost = next((row.measured for row in one.rows if row.name == "loss"), 0.0)
    if off and (read := next(_of_machine(one.evidence, off, lost), None)):
        yield read
        if read[0] != "throttled":
            return
    for code, name, low, high, text in _BY_NUMBERS:
        if name in off and low <= _ratio(off[name]) <= high:
            yield code, describe(off[name]) + text
            return


def _of_machine(
    known: ShaperFacts, off: Mapping[str, Judgement], lost: float
) -> Iterator[tuple[str, str]]:
    """Yield code and text of each cause that this machine's counters show, the most certain first.

    `known` has the counters. `off` has the measurements outside their limits, by name. `lost` is
    the share of lost packets.
    """
    where, elsewhere = known.interface or "the way out", " and ".join(known.elsewhere)
    sent, unshaped = known.sent or 0, known.shaper == "none"
    passed = sent if known.passed is None else known.passed
    raised = any(name in off and _ratio(off[name]) > 1.0 for name in RAISED)
    table = (
        ("no_sch_netem", unshaped and "sch_netem" in known.why,
         f"{known.why}; set link.mode=relay, which needs none"),
        ("wrong_interface", unshaped and elsewhere,
         f"the flow leaves by {where}, but the qdisc is on {elsewhere}"),
        ("no_qdisc", unshaped or known.restored,
         f"another program removed or changed the qdisc on {where}"),
        ("bypassed", passed < PASSED * sent * (1.0 - lost),
         f"of {sent} datagrams only {passed} passed the shaper"),
        ("shaped_twice", known.layers > 1,
         f"the flow passes {known.layers} shapers: remove all but one"),
        ("throttled", known.starved and raised,
         f"the shaper lacks CPU time ({known.starved}): raise its limit or take load off the "
         "machine"),
        ("nothing_arrives", lost > 0.999, "not one datagram arrives: is the route open?"),
    )  # fmt: skip
    yield from ((code, text) for code, holds, text in table if holds)


def _ratio(row: Judgement) -> float:
    return row.measured / row.asked if row.asked else inf


def describe(row: Judgement) -> str:
    """Return a text such as "mean 52.00 ms instead of 40.00 ms", the measured value first."""
    return f"{row.name} {in_unit(row.measured, row.unit)} instead of {in_unit(row.asked, row.unit)}"


def in_unit(value: float, unit: str) -> str:
    """Format a `value` in `unit`: [s] as ms, [1] as %, [bit/s] as kbit/s; NaN as "-"."""
    if isnan(value):
        return "-"
    if unit == "bit/s":
        return "no limit" if value > 1e12 else f"{value * 1e-3:.0f} kbit/s"
    return f"{value * 1e3:.2f} ms" if unit == "s" else f"{value:.2%}"
