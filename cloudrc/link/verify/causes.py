"""Name why a link is not what was requested, by its rows and by what its machine reports.

What can be read (qdiscs, counters, release errors) comes before what follows from the numbers.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import inf, isnan, sqrt
from typing import NamedTuple, TypeAlias

from cloudrc.link.profile import DirectionProfile
from cloudrc.link.sidecar import Told
from cloudrc.link.verify.judge import Row, netem_makes

LATE = 1.5e-3
"""A relay whose 99 % quantile of the release error exceeds this lacks CPU [s]."""
UNREAD, STOPPED, PASSED = 0.003, 0.01, 0.9
"""Shares [1]: a shaper that leaves more unread, or is stopped in more CPU periods, lacks CPU; if it
counts less than the last one of what arrived, the rest takes another way."""
CPU_PERIOD = 0.1
"""Period of a CPU limit [s]. Source: Linux, sched-bwc.rst, cpu.cfs_period_us."""


@dataclass(frozen=True, slots=True)
class Evidence:
    """What the machine reports about the shaper of one direction; None or "" if it is unknown.

    Its release error is `late` [s]; its CPU limit stops it in a share `throttled` of periods [1].
    """

    shaper: str = ""  # "relay", "netem"; "none" if the kernel has none where the flow leaves
    why: str = ""  # why this shaper, in words
    interface: str = ""  # over which the flow leaves
    elsewhere: tuple[str, ...] = ()  # other interfaces that have a netem qdisc
    layers: int | None = None  # number of shapers that the flow passes
    applied: DirectionProfile | None = None  # in force, by the shaper's own word
    sent: int | None = None  # datagrams that the end sent
    passed: int | None = None  # of them, those that the shaper counted
    unread: int | None = None  # of them, those that the shaper did not read in time
    late: float | None = None  # 99 % quantile
    throttled: float | None = None
    restored: int = 0  # times that somebody else removed or changed the qdisc


Metrics: TypeAlias = Mapping[str, float]
"""Values by "name" or "name/value of its label"."""


def read_metrics(text: str) -> Metrics:
    """Read metrics from Prometheus' text format."""
    found = re.findall(r"^(\w+)(?:\{(.*)\})? (\S+)$", text, re.MULTILINE)
    names = ["/".join((name, *re.findall(r'="([^"]*)"', labels))) for name, labels, _ in found]
    return {name: float(value) for name, (_, _, value) in zip(names, found, strict=True)}


def read_evidence(told: Told, metrics: Metrics, sent: int | None = None) -> Evidence:
    """Combine a link process's page /link.json, which names the qdiscs, and its metrics.

    `sent` is what its end has sent since the process started; None if that was not counted.
    """
    netem, counted = told.shaper == "netem", sent is not None and bool(metrics)
    shaper, applied, layers = told.shaper, told.applied, 1
    interface, elsewhere = "", tuple[str, ...]()
    received, unread = (
        int(metrics.get(f"cloudrc_link_datagrams_total/{one}", 0.0)) if counted else None
        for one in ("received", "unread")
    )
    passed = None if netem else received
    if near := told.near:
        interface, here = near.interface, list(near.netems.get(near.interface, ()))
        if not netem:  # an end reaches a relay over lo
            here += near.netems.get("lo", ()) if interface != "lo" else ()
            layers = 1 + len(here)
        else:
            elsewhere = tuple(sorted(set(near.netems) - {interface}))
            layers = len(here)
            counts = [int(one.get("packets", 0)) + int(one.get("drops", 0)) for one in here]
            passed = max(counts) if counts and sent is not None else None
            shaper, applied = ("netem", applied) if here else ("none", None)
    stopped = metrics.get("cloudrc_cpu_throttled_periods_total", 0.0)
    periods = metrics.get("cloudrc_cpu_periods_total", 0.0)
    return Evidence(
        *(shaper, told.why, interface, elsewhere, layers or None),
        applied=netem_makes(applied) if netem and applied else applied,
        sent=sent,
        passed=passed,
        unread=unread,
        late=metrics.get("cloudrc_link_release_error_seconds/99"),
        throttled=stopped / periods if periods else None,
        restored=int(metrics.get("cloudrc_link_restored_total", 0.0)),
    )


class Cause(NamedTuple):
    """A word for programs, a direction ("uplink", "downlink" or "both"), a sentence."""

    code: str
    way: str
    text: str


class Findings(NamedTuple):
    """What is known about one direction."""

    rows: Sequence[Row]
    evidence: Evidence


def find_causes(findings: Mapping[str, Findings]) -> list[Cause]:
    """Name what is wrong with each direction of a link; nothing if no row is off."""
    found = {way: list(_causes_of(one)) for way, one in findings.items()}
    silent = [way for way, causes in found.items() if causes and causes[0][0] in _UNSHAPED]
    shaped = [way for way in findings if way not in silent]
    if len(silent) == len(shaped) == 1 and not findings[silent[0]].evidence.restored:
        text = f"only the {shaped[0]} is shaped: {found[silent[0]][0][1]}"
        found[silent[0]] = [("one_direction", text)]
    if len({*map(tuple, found.values())}) == 1 < len(found):
        found = {"both": found[silent[0] if silent else shaped[0]]}
    return [Cause(code, way, text) for way, causes in found.items() for code, text in causes]


_UNSHAPED = ("no_qdisc", "wrong_interface", "no_sch_netem", "not_shaped")
_BY_NUMBERS = (
    ("not_shaped", "mean", 0.0, 0.15, ": nothing shapes the flow"),
    ("order_kept", "reordered", 0.0, 0.2, ": order is kept although reordering was requested"),
    ("order_broken", "reordered", 3.0, inf, ": order should be kept"),
    ("doubled_delay", "mean", 1.8, 2.2, ": it is shaped twice, or requested twice"),
    ("halved_delay", "mean", 0.45, 0.55, ": a round trip was taken for one way"),
    ("rate_ignored", "rate", 1.0, inf, ": the rate is ignored"),
    ("slow", "rate", 0.0, 1.0, ": something is slower"),
    ("wrong_delay", "mean", 0.0, inf, ""),
    ("wrong_delay", "round_trip", 0.0, inf, ""),
    ("wrong_jitter", "deviation", 0.0, inf, ": another jitter"),
    ("no_loss", "loss", 0.0, 0.05, ": loss is not applied"),
    ("less_loss", "loss", 0.0, 1.0, ""),
    ("more_loss", "loss", 1.0, inf, ""),
    ("wrong_duplicates", "duplicated", 0.0, inf, ""),
    ("wrong_order", "reordered", 0.0, inf, ""),
    ("wrong_distribution", "distribution", 0.0, inf, ": delays are distributed otherwise"),
)
"""Code, quantity, measured by requested value from and to [1], text: the surest first."""


def _causes_of(one: Findings) -> Iterator[tuple[str, str]]:
    """Give the first cause that holds, and beside a lack of CPU what that cannot explain."""
    off = {row.name: row for row in one.rows if row.verdict == "off"}
    lost = next((row.measured for row in one.rows if row.name == "loss"), 0.0)
    if off and (read := next(_of_machine(one.evidence, off, lost), None)):
        yield read
        if read[0] != "throttled":
            return
        beyond = lost > 1.2 * (one.evidence.unread or 0) / (one.evidence.sent or 1)
        kept = {name for name, row in off.items() if (_ratio(row) < 1.0) != (name == "rate")}
        off = {name: off[name] for name in off if name in kept or (name == "loss" and beyond)}
    for code, name, low, high, text in _BY_NUMBERS:
        if name in off and low <= _ratio(off[name]) <= high:
            yield (code, describe(off[name]) + text)
            return


def _of_machine(known: Evidence, off: Mapping[str, Row], lost: float) -> Iterator[tuple[str, str]]:
    """Look at what can be read, the surest first; a share `lost` [1] did not arrive."""
    where, elsewhere = known.interface or "the way out", " and ".join(known.elsewhere)
    sent, unread, late, stopped = (
        value or 0 for value in (known.sent, known.unread, known.late, known.throttled)
    )
    unshaped, passed = known.shaper == "none", sent if known.passed is None else known.passed
    longest = max(late * (late > LATE), sqrt(stopped) * CPU_PERIOD * (stopped > STOPPED))
    slower = any((_ratio(row) > 1.0) != (row.name == "rate") for row in off.values())
    excess = off["mean"].measured - off["mean"].asked if "mean" in off else 0.0
    table = (
        ("no_sch_netem", unshaped and "sch_netem" in known.why,
         f"{known.why}; set link.mode=relay, which needs none"),
        ("wrong_interface", unshaped and elsewhere,
         f"the flow leaves by {where}, but the qdisc is on {elsewhere}"),
        ("no_qdisc", unshaped or known.restored,
         f"somebody else removed or changed the qdisc on {where}"),
        ("bypassed", passed + unread < PASSED * sent * (1.0 - lost),
         f"of {sent} datagrams only {passed} passed the shaper"),
        ("shaped_twice", (known.layers or 0) > 1,
         f"the flow passes {known.layers} shapers: remove all but one"),
        ("throttled", unread > UNREAD * sent or (slower and 0.0 <= excess < longest),
         f"the shaper lacks CPU time ({unread} of {sent} datagrams not read; 1 % released later "
         f"than {in_unit(late, 's')}; stopped in {stopped:.0%} of the periods): raise its limit or "
         "take load off the machine"),
        ("nothing_arrives", lost > 0.999, "not one datagram arrives: is the route open?"),
    )  # fmt: skip
    yield from ((code, text) for code, holds, text in table if holds)


def _ratio(row: Row) -> float:
    """Return the measured by the requested value [1]; a rate may be known by the shaper alone."""
    value = row.applied if isnan(row.measured) else row.measured
    return value / row.asked if row.asked else inf


def describe(row: Row) -> str:
    """Compare a measured value with the requested one, and with what the shaper says."""
    asked, applied = in_unit(row.asked, row.unit), in_unit(row.applied, row.unit)
    if isnan(row.measured):
        return f"the shaper says {applied} instead of {asked}"
    text = f"{row.name} {in_unit(row.measured, row.unit)} instead of {asked}"
    if isnan(row.applied) or row.name not in ("mean", "rate"):
        return text
    as_told = abs(row.applied - row.measured) < 0.5 * abs(row.asked - row.measured)
    return f"{text}; the shaper says {applied}" + (": it was told so" if as_told else "")


def in_unit(value: float, unit: str) -> str:
    """Write a value [s], [1] or [bit/s] in ms, % or kbit/s."""
    if unit == "bit/s":
        return "no limit" if value > 1e12 else f"{value * 1e-3:.0f} kbit/s"
    return f"{value * 1e3:.2f} ms" if unit == "s" else f"{value:.2%}"
