"""Report the verdict on a link: a table with notes for people, a document for programs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from math import isfinite, isnan
from typing import Any

from cloudrc.cli.output import escape, paint, table
from cloudrc.link.verify.causes import Findings, find_causes
from cloudrc.link.verify.judge import Row, verdict_of

COLOURS = {"ok": "green", "off": "red", "open": "yellow", "believed": "green"}
NAMES = {"mean": "delay, mean", "deviation": "standard deviation", "loss": "lost"}
NAMES |= {"round_trip": "round trip, mean"}
SCALES = {"s": (1e3, "ms"), "1": (1e2, "%"), "bit/s": (1e-3, "kbit/s")}
NOT_JUDGED = "NOT JUDGED"
"""Mark in a note: something that the profile asks for was not verified."""


@dataclass(frozen=True, slots=True)
class VerifyReport:
    """Result of verifying a link.

    Attributes:
        title: Name of the profile, experiment or release.
        findings: Rows and evidence by direction.
        probes: Description of the datagrams by direction.
        notes: What was judged loosely or not at all.
        more: Advice if the verdict is undecided.
    """

    title: str
    findings: Mapping[str, Findings]
    probes: Mapping[str, str]
    notes: Sequence[str] = ()
    more: str = "too few probes; give more --seconds"

    @property
    def verdict(self) -> str:
        """Overall verdict: "believed", "not believed" or "undecided"."""
        verdicts = {verdict_of(one.rows) for one in self.findings.values()}
        if "off" in verdicts:
            return "not believed"
        return "believed" if verdicts == {"ok"} else "undecided"

    @property
    def shaper(self) -> str:
        """Name of the shapers of both directions, in words."""
        names = {one.evidence.shaper or "an unknown shaper" for one in self.findings.values()}
        return f"shaped by {' and '.join(sorted(names))}"


def as_text(report: VerifyReport) -> str:
    """Format a table per direction, notes, causes, and the verdict in the last line."""
    lines = [escape(f"{report.title}: {report.shaper}")]
    for way, found in report.findings.items():
        rows = [
            (way, "asked", "applied", "measured", "allowed", "verdict"),
            *map(_cells, found.rows),
        ]
        head, *body = table(rows, right=[1, 2, 3, 4]).splitlines()
        lines += ["", paint(head, "bold"), paint(escape(f"  {report.probes[way]}"), "dim")]
        for line, row in zip(body, found.rows, strict=True):
            lines.append(line.removesuffix(row.verdict) + paint(row.verdict, COLOURS[row.verdict]))
    lines += ["", *map(escape, report.notes)]
    causes = find_causes(report.findings)
    lines += [escape(f"  {cause.way}: {cause.text}  [{cause.code}]") for cause in causes]
    partly = any(NOT_JUDGED in note for note in report.notes)
    words = {
        "believed": "BELIEVED: the link matches its profile"
        + (f", except what is {NOT_JUDGED} (above)" if partly else ""),
        "not believed": "NOT BELIEVED: the link does not match its profile",
        "undecided": f"UNDECIDED: {report.more}",
    }
    return "\n".join([*lines, paint(words[report.verdict], COLOURS.get(report.verdict, "red"))])


def _cells(row: Row) -> tuple[str, ...]:
    scale, unit = SCALES[row.unit]
    asked, applied, measured, low, high = (_number(one * scale) for one in row[2:7])
    allowed = f"<= {high}" if row.low <= 0.0 else f"{low} .. {high}"
    return (
        f"  {NAMES.get(row.name, row.name)} [{unit}]",
        asked,
        applied,
        measured,
        allowed,
        row.verdict,
    )


def _number(value: float) -> str:
    if isnan(value):
        return "-"
    return "none" if value > 1e12 else f"{value:.2f}" if value < 1e4 else f"{value:.0f}"


def as_document(report: VerifyReport) -> dict[str, Any]:
    """Convert to plain values: SI units, shares in [0, 1]; unknown values are left out."""
    ways = {}
    for way, found in report.findings.items():
        known = {**asdict(found.evidence), "applied": None}
        ways[way] = {
            "probes": report.probes[way],
            "rows": [_known(row._asdict()) for row in found.rows],
            "evidence": _known(known),
        }
    return {
        "schemaVersion": 1,
        "verdict": report.verdict,
        "link": report.title,
        "shaper": report.shaper,
        "causes": [cause._asdict() for cause in find_causes(report.findings)],
        "notes": list(report.notes),
        "directions": ways,
    }


def _known(values: Mapping[str, Any]) -> dict[str, Any]:
    """Leave out unknown values."""
    return {
        key: value
        for key, value in values.items()
        if value not in (None, "", ()) and not (isinstance(value, float) and not isfinite(value))
    }


def on_correlation(way: str, asked: float) -> str:
    """Note that netem does not realise a correlation of `asked` [1]."""
    return f"{way}: correlation {asked:g} {NOT_JUDGED}: netem realises almost none of it"
