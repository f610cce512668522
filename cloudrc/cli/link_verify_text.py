"""The verdict on a link for people and for programs: a table on a terminal, or JSON.

What is said beside the table of a verdict: how it was probed, and what was not judged.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import inf, isfinite, isnan
from typing import Any

from cloudrc.cli.output import harmless, paint, table
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
"""In a note: something that was asked for is not known to be so."""


@dataclass(frozen=True, slots=True)
class Said:
    """What was found out about a link.

    Attributes:
        title: What was asked for.
        shaper: Who shapes it, in words.
        findings: By direction.
        probes: What was sent, in words, by direction.
        notes: What else there is to know.
        causes: Why it is not believed.
        more: What helps if it is undecided.
    """

    title: str
    shaper: str
    findings: Mapping[str, Findings]
    probes: Mapping[str, str]
    notes: Sequence[str]
    causes: Sequence[Cause]
    more: str = "too few probes to say; give --seconds more"

    @property
    def verdict(self) -> str:
        """Believed, not believed, or undecided."""
        ways = [[row.verdict for row in deciding(one.rows)] for one in self.findings.values()]
        if any("off" in verdicts for verdicts in ways):
            return "not believed"
        return "believed" if all(set(verdicts) == {"ok"} for verdicts in ways) else "undecided"


def deciding(rows: Sequence[Row]) -> list[Row]:
    """Rows that a verdict rests on: a rate too high to be measured does not hold it up."""
    return [
        row
        for row in rows
        if row.verdict != "told" and not (row.name == "rate" and row.verdict == "open")
    ]


def as_text(said: Said) -> str:
    """Lay out a table per direction, the causes, and the verdict in the last line."""
    rows: list[tuple[str, ...]] = []
    for way, found in said.findings.items():
        rows.append((way, *HEADINGS[1:]))
        rows += [_cells(row) for row in found.rows]
    lines = table(rows, right=[1, 2, 3, 4]).splitlines()
    verdicts = iter([row.verdict for found in said.findings.values() for row in found.rows])
    painted, index = [harmless(f"{said.title}: {said.shaper}")], 0
    for way, found in said.findings.items():
        painted += [
            "",
            paint(lines[index], "bold"),
            paint(harmless(f"  {said.probes[way]}"), "dim"),
        ]
        for line in lines[index + 1 : index + 1 + len(found.rows)]:
            verdict = next(verdicts)
            cut = line.rindex(verdict)
            painted.append(line[:cut] + paint(verdict, COLOURS[verdict]))
        index += 1 + len(found.rows)
    painted += ["", *map(harmless, said.notes)] if said.notes else [""]
    painted += [harmless(f"  {cause.way}: {cause.text}  [{cause.code}]") for cause in said.causes]
    return "\n".join([*painted, _last_line(said)])


def _last_line(said: Said) -> str:
    verdict = said.verdict
    colours = {"believed": "green", "not believed": "red", "undecided": "yellow"}
    partly = any(NOT_JUDGED in note for note in said.notes)
    but = f", but for what is {NOT_JUDGED} (above)" if partly else ""
    words = {
        "believed": f"BELIEVED: the link is what was asked for{but}",
        "not believed": "NOT BELIEVED: the link is not what was asked for",
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


def as_document(said: Said) -> dict[str, Any]:
    """Write it for programs; numbers in SI, shares in [0, 1]; what is unknown is left out."""
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
