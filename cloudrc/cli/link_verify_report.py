"""Report the verdict on a link: a document for programs, a table with notes for people."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from math import isfinite, nan
from typing import Any, TypeAlias

from cloudrc.cli.output import escape, paint, table
from cloudrc.link.verify.causes import Findings, find_causes
from cloudrc.link.verify.judge import verdict_of

COLOURS = {"ok": "green", "off": "red", "open": "yellow"}
NAMES = {"mean": "delay, mean", "deviation": "standard deviation", "loss": "lost"}
SCALES = {"s": (1e3, "ms"), "1": (1e2, "%"), "bit/s": (1e-3, "kbit/s")}
NOT_JUDGED = "NOT JUDGED"
"""Mark in a note: something that the profile asks for was not verified."""
VERDICTS = {"off": "not believed", "open": "undecided", "ok": "believed"}

Report: TypeAlias = dict[str, Any]


def make_report(
    title: str, findings: Mapping[str, Findings], probes: Mapping[str, str], notes: Sequence[str]
) -> Report:
    """Make plain values in SI units, shares in [0, 1]; unknown values are left out."""
    shapers = {one.evidence.shaper or "an unknown shaper" for one in findings.values()}
    verdicts = {verdict_of(one.rows) for one in findings.values()}
    return {
        "schemaVersion": 1,
        "verdict": next(word for verdict, word in VERDICTS.items() if verdict in verdicts),
        "link": title,
        "shaper": f"shaped by {' and '.join(sorted(shapers))}",
        "causes": [cause._asdict() for cause in find_causes(findings)],
        "notes": list(notes),
        "directions": {
            way: {
                "probes": probes[way],
                "rows": [_known(row._asdict()) for row in found.rows],
                "evidence": _known(asdict(found.evidence) | {"applied": None}),
            }
            for way, found in findings.items()
        },
    }


def _known(values: Mapping[str, Any]) -> dict[str, Any]:
    return {
        key: value
        for key, value in values.items()
        if value not in (None, "", ()) and not (isinstance(value, float) and not isfinite(value))
    }


def as_text(report: Report) -> str:
    """Format a table per direction, notes, causes, and the verdict in the last line."""
    lines = [escape(f"{report['link']}: {report['shaper']}")]
    for way, found in report["directions"].items():
        rows = [[way, "asked", "applied", "measured", "allowed", "verdict"]]
        head, *body = table(
            rows + [_cells(row) for row in found["rows"]], [1, 2, 3, 4]
        ).splitlines()
        lines += ["", paint(head, "bold"), paint(escape(f"  {found['probes']}"), "dim")]
        for line, verdict in zip(body, (row["verdict"] for row in found["rows"]), strict=True):
            lines.append(line.removesuffix(verdict) + paint(verdict, COLOURS[verdict]))
    causes = [f"  {one['way']}: {one['text']}  [{one['code']}]" for one in report["causes"]]
    lines += ["", *map(escape, [*report["notes"], *causes])]
    partly = any(NOT_JUDGED in note for note in report["notes"])
    words = {
        "believed": f"matches its profile{f', except what is {NOT_JUDGED} (above)' * partly}",
        "not believed": "does not match its profile",
        "undecided": "was not measured for long enough: give more --seconds, or ask again",
    }
    colour = {"believed": "green", "undecided": "yellow"}.get(report["verdict"], "red")
    verdict = report["verdict"]
    return "\n".join([*lines, paint(f"{verdict.upper()}: the link {words[verdict]}", colour)])


def _cells(row: Mapping[str, Any]) -> list[str]:
    scale, unit = SCALES[row["unit"]]
    names = ("asked", "applied", "measured", "low", "high")
    asked, applied, measured, low, high = (_number(row.get(name, nan) * scale) for name in names)
    allowed = f"{low} .. {high}" if row.get("low") else f"<= {high}"
    name = NAMES.get(row["name"], row["name"].replace("_", " "))
    return [f"  {name} [{unit}]", asked, applied, measured, allowed, row["verdict"]]


def _number(value: float) -> str:
    return "-" if not isfinite(value) else f"{value:.2f}" if value < 1e4 else f"{value:.0f}"


def on_correlation(way: str, asked: float) -> str:
    """Note that netem does not realise a correlation of `asked` [1]."""
    return f"{way}: correlation {asked:g} {NOT_JUDGED}: netem realises almost none of it"
