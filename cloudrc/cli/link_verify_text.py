"""Report the verdict on a link: a table with notes for people, a document for programs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import inf, isfinite, isnan
from typing import Any

from cloudrc.cli.output import escape, paint, table
from cloudrc.link.verify.causes import Cause, Findings
from cloudrc.link.verify.expect import DEVIATION_FLOOR, JITTER_SHARES, has_jitter
from cloudrc.link.verify.judge import SIZE, Row, Trains
from cloudrc.link.verify.plan import LONGEST, Plan
from cloudrc.link.verify.standing import PERIOD

COLOURS = {"ok": "green", "off": "red", "open": "yellow"}
NAMES = {
    "mean": "delay, mean",
    "deviation": "standard deviation",
    "variation": "delay variation",
    "middle": "deviation, middle",
    "loss": "lost",
    "reordered": "reordered",
    "duplicated": "duplicated",
    "corrupted": "damaged",
    "rate": "rate",
    "round_trip": "round trip, mean",
}
HEADINGS = ("", "asked", "applied", "measured", "allowed", "verdict")
_SCALES = {"s": (1e3, "ms"), "1": (1e2, "%"), "bit/s": (1e-3, "kbit/s")}
DIGITS = 2
NOT_JUDGED = "NOT JUDGED"
"""Mark in a note: something that the profile asks for was not verified."""


@dataclass(frozen=True, slots=True)
class VerifyReport:
    """Result of verifying a link.

    Attributes:
        title: Name of the profile, experiment or release.
        shaper: Description of the shaper.
        findings: Measurements and verdicts, by direction.
        probes: Description of the probes, by direction.
        notes: What was judged loosely or not at all.
        causes: Why the link is not believed.
        more: Advice if the verdict is undecided.
    """

    title: str
    shaper: str
    findings: Mapping[str, Findings]
    probes: Mapping[str, str]
    notes: Sequence[str]
    causes: Sequence[Cause]
    more: str = "too few probes; give more --seconds"

    @property
    def verdict(self) -> str:
        """Overall verdict: "believed", "not believed" or "undecided"."""
        ways = [[row.verdict for row in deciding(one.rows)] for one in self.findings.values()]
        if any("off" in verdicts for verdicts in ways):
            return "not believed"
        return "believed" if all(set(verdicts) == {"ok"} for verdicts in ways) else "undecided"


def deciding(rows: Sequence[Row]) -> list[Row]:
    """Select the rows that count for the verdict; a rate too high to measure does not."""
    return [
        row
        for row in rows
        if row.verdict != "told" and not (row.name == "rate" and row.verdict == "open")
    ]


def as_text(said: VerifyReport) -> str:
    """Format a table per direction, the causes, and the verdict in the last line."""
    rows: list[tuple[str, ...]] = []
    for way, found in said.findings.items():
        rows.append((way, *HEADINGS[1:]))
        rows += [_cells(row) for row in found.rows]
    lines = table(rows, right=[1, 2, 3, 4]).splitlines()
    verdicts = iter([row.verdict for found in said.findings.values() for row in found.rows])
    painted, index = [escape(f"{said.title}: {said.shaper}")], 0
    for way, found in said.findings.items():
        painted += [
            "",
            paint(lines[index], "bold"),
            paint(escape(f"  {said.probes[way]}"), "dim"),
        ]
        for line in lines[index + 1 : index + 1 + len(found.rows)]:
            verdict = next(verdicts)
            cut = line.rindex(verdict)
            painted.append(line[:cut] + paint(verdict, COLOURS[verdict]))
        index += 1 + len(found.rows)
    painted += ["", *map(escape, said.notes)] if said.notes else [""]
    painted += [escape(f"  {cause.way}: {cause.text}  [{cause.code}]") for cause in said.causes]
    return "\n".join([*painted, _last_line(said)])


def _last_line(said: VerifyReport) -> str:
    verdict = said.verdict
    colours = {"believed": "green", "not believed": "red", "undecided": "yellow"}
    partly = any(NOT_JUDGED in note for note in said.notes)
    exception = f", except what is {NOT_JUDGED} (above)" if partly else ""
    words = {
        "believed": f"BELIEVED: the link matches its profile{exception}",
        "not believed": "NOT BELIEVED: the link does not match its profile",
        "undecided": f"UNDECIDED: {said.more}",
    }
    return paint(words[verdict], colours[verdict])


def _cells(row: Row) -> tuple[str, ...]:
    scale, unit = _SCALES[row.unit if row.name not in SHARES else "1"]
    return (
        f"  {NAMES[row.name]} [{unit}]",
        _number(row.asked * scale),
        _number(row.applied * scale),
        _number(row.measured * scale),
        _range(row.low * scale, row.high * scale),
        row.verdict,
    )


SHARES = ("loss", "reordered", "duplicated", "corrupted")


def _number(value: float) -> str:
    if isnan(value):
        return "-"
    if value == inf or value > 1e12:
        return "none"
    return f"{value:.{DIGITS}f}" if abs(value) < 1e4 else f"{value:.0f}"


def _range(low: float, high: float) -> str:
    if low > high:
        return "-"
    if low <= 0.0:
        return f"<= {_number(high)}"
    return f"{_number(low)} .. {_number(high)}"


def as_document(said: VerifyReport) -> dict[str, Any]:
    """Convert to plain values: SI units, shares in [0, 1]; unknown values are left out."""
    return {
        "schemaVersion": 1,
        "verdict": said.verdict,
        "link": said.title,
        "shaper": said.shaper,
        "causes": [cause._asdict() for cause in said.causes],
        "notes": list(said.notes),
        "directions": {
            way: {
                "probes": said.probes[way],
                "rows": [_object(row) for row in found.rows],
                "evidence": _evidence(found),
            }
            for way, found in said.findings.items()
        },
    }


def _object(row: Row) -> dict[str, Any]:
    return {
        key: value
        for key, value in row._asdict().items()
        if not isinstance(value, float) or isfinite(value)
    }


def _evidence(found: Findings) -> dict[str, Any]:
    evidence = found.evidence
    names = (
        "shaper",
        "why",
        "interface",
        "elsewhere",
        "layers",
        "sent",
        "passed",
        "unread",
        "late",
    )
    values = {name: getattr(evidence, name) for name in (*names, "throttled", "restored")}
    return {name: value for name, value in values.items() if value not in (None, "", ())}


def shaper_in_words(findings: Mapping[str, Findings]) -> str:
    """Name the shapers of both directions."""
    names = sorted({one.evidence.shaper for one in findings.values()})
    return f"shaped by {' and '.join(names)}"


def describe(plan: Plan, trains: Trains | None) -> str:
    """Describe the probes of a direction."""
    schedule = plan.schedule
    text = f"{schedule.count} probes of {schedule.size} bytes, {1 / schedule.period:.0f} per second"
    if trains and trains.count:
        text += f"; {trains.count} trains of {trains.length} x {SIZE} bytes"
    return text


def notes(way: str, plan: Plan, trains: Trains | None) -> Iterator[str]:
    """Note what is judged more loosely than usual, or not at all."""
    if not plan.enough:
        seconds = plan.needs * plan.schedule.period
        yield (
            f"{way}: its delays vary so much that {seconds:.0f} s of probes are needed (default: "
            f"at most {LONGEST:.0f}); give --seconds {seconds:.0f}"
        )
    if has_jitter(plan.profile):
        yield from on_jitter(way, plan.expects.share)
        expects = plan.expects
        if expects.share and expects.variation is None and expects.middle is None:
            yield from on_deviation(way, expects.deviation.expected)
    if trains and not trains.judges:
        yield f"{way}: rate {NOT_JUDGED}: too high to be distinguished from no limit"


def on_jitter(way: str, share: float) -> Iterator[str]:
    """Note the share [1] by which jitter may be off, unless it is the usual 10 %."""
    usual = JITTER_SHARES[0]
    if not share:
        yield f"{way}: jitter {NOT_JUDGED}: jitter is too small a part of the delay variation"
    elif share > usual:
        yield (
            f"{way}: jitter judged within {share:.0%} only: the tail of its distribution hides "
            f"{usual:.0%}"
        )


def on_correlation(way: str, asked: float) -> Iterator[str]:
    """Note that netem does not realise a correlation, if `asked` [1] is not zero."""
    if asked:
        yield f"{way}: correlation {asked:g} {NOT_JUDGED}: netem realises almost none of it"


def on_patience(way: str, name: str, needs: float) -> Iterator[str]:
    """Note that a quantity needs more datagrams than are kept.

    Args:
        way: The direction.
        name: Name of the row.
        needs: Number of datagrams [1]; infinite if delays of the ends hide the quantity.
    """
    why = "delays inside the ends may hide it, for any number of datagrams"
    if isfinite(needs):
        why = f"needs {needs:.0f} datagrams, {needs * PERIOD:.0f} s of a flight"
    yield f"{way}: {NAMES.get(name, name)} {NOT_JUDGED}: {why}"


def on_deviation(way: str, asked: float) -> Iterator[str]:
    """Note that the requested jitter is too small for the usual margin of 10 %.

    Args:
        way: The direction.
        asked: Requested standard deviation [s].
    """
    if 0.0 < asked < 2.0 * DEVIATION_FLOOR:
        yield (
            f"{way}: standard deviation, and so its jitter, judged within "
            f"{DEVIATION_FLOOR * 1e3:g} ms only: below {2e3 * DEVIATION_FLOOR:g} ms the machine "
            "itself adds as much"
        )
