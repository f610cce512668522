"""Verify the link of a release in flight by what its pods report, and report any verdict.

The tunnel's own datagrams are the probes. Each end judges the direction that it receives and serves
the result at /link.json of its metrics port; there each link container shows what it shapes.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict
from math import inf, isfinite, nan
from typing import Any, TypeAlias

import numpy as np

from cloudrc.cli.output import escape, paint, table
from cloudrc.cluster.pods import METRICS, NO_PROXY
from cloudrc.errors import TimedOutError
from cloudrc.link.profile import DirectionProfile
from cloudrc.link.sidecar import Told, read_told
from cloudrc.link.verify.causes import Findings, find_causes, read_evidence, read_metrics
from cloudrc.link.verify.expect import RUN_LENGTH, Flow, Plan
from cloudrc.link.verify.judge import UNITS, Row, tolerance, verdict_of
from cloudrc.link.verify.monitor import PERIOD
from cloudrc.tunnel.codec import SIZES, Kind

END_PORT, LINK_PORT = METRICS["world"]["world"], METRICS["world"]["link"]
POLL_PERIOD, OFF_TIMEOUT, HTTP_TIMEOUT = 2.0, 30.0, 3.0
"""Pause between two polls, longest wait for a verdict once the other is "off", for a page [s]."""
WAYS = {
    "uplink": ("world", "cloud", Kind.TELEMETRY),
    "downlink": ("cloud", "world", Kind.COMMAND),
}
"""Direction -> the end that sends in it, the end that receives, and what."""

COLOURS = {"ok": "green", "off": "red", "open": "yellow"}
NAMES = {"mean": "delay, mean", "deviation": "standard deviation", "loss": "lost"}
SCALES = {"s": (1e3, "ms"), "1": (1e2, "%"), "bit/s": (1e-3, "kbit/s")}
NOT_JUDGED = "NOT JUDGED"
"""Mark in a note: something that the profile asks for was not verified."""
VERDICTS = {"off": "not believed", "open": "undecided", "ok": "believed"}

Report: TypeAlias = dict[str, Any]
Pods: TypeAlias = Mapping[str, Sequence[str]]
"""End -> URLs of its own pages and of those of its link container."""


def verify(title: str, pods: Pods, limit: float, tell: Callable[[str], None]) -> Report:
    """Wait at most `limit` [s] for the verdicts of both ends.

    Raises:
        TimedOutError: If an end does not answer in time.
    """
    deadline, off_deadline = time.monotonic() + limit, inf
    seen = dict[str, Any]()
    while True:
        tell(", ".join(note for way, found in seen.items() for note in _patience(way, found)))
        time.sleep(POLL_PERIOD)
        for way, (_, receiver, _) in WAYS.items():
            if page := fetch(f"{pods[receiver][0]}/link.json"):
                seen[way] = json.loads(page)
        verdicts, now = [found["verdict"] for found in seen.values()], time.monotonic()
        off_deadline = min(off_deadline, now + OFF_TIMEOUT) if "off" in verdicts else inf
        done = len(seen) == len(WAYS) and "open" not in verdicts
        if done or now >= min(deadline, off_deadline):
            break
    tell("")
    if silent := [receiver for way, (_, receiver, _) in WAYS.items() if way not in seen]:
        text = f"{' and '.join(silent)} did not answer within {limit:g} s: are the pods ready?"
        raise TimedOutError(text)
    findings = {way: _findings(way, seen[way], pods[WAYS[way][0]][1]) for way in WAYS}
    counts = {way: max([row["datagrams"] for row in seen[way]["rows"]], default=0) for way in WAYS}
    probes = {way: f"{count} of the tunnel's own datagrams" for way, count in counts.items()}
    notes = [note for way in WAYS for note in _notes(way, seen[way], findings[way])]
    return make_report(title, findings, probes, notes)


def fetch(url: str) -> str:
    """Fetch a page without a proxy; "" without an answer."""
    try:
        with NO_PROXY.open(url, timeout=HTTP_TIMEOUT) as page:
            return str(page.read().decode())
    except OSError:
        return ""


def _findings(way: str, found: Mapping[str, Any], link: str) -> Findings:
    """Combine the receiver's verdict with what the sender's link reports at a URL."""
    kind = WAYS[way][2]
    try:
        told = read_told(fetch(f"{link}/link.json"))
    except ValueError:
        told = Told("", "", None)
    known = read_evidence(told, read_metrics(fetch(f"{link}/metrics")))
    flow = Flow(0, way == "uplink", kind, SIZES[kind])
    plan = Plan(DirectionProfile(), flow, np.arange(float(RUN_LENGTH)) * PERIOD)
    applied, rows = plan.applied(known.applied), []
    for row in found["rows"]:
        name, judged = row["quantity"], row["verdict"] != "told"
        values = (row.get(key, nan) for key in ("asked", "measured", "low", "high"))
        asked, measured, low, high = map(float, values)
        in_force = applied.get(name, nan)
        if name == "rate" and known.applied:  # single datagrams do not measure it
            in_force, slack = known.applied.rate or inf, tolerance("rate", asked)
            judged, low, high = abs(in_force - asked) > slack, asked - slack, asked + slack
        if judged:
            verdict = row["verdict"] if name != "rate" else "off"
            unit = UNITS.get(name, "1")
            rows.append(Row(name, unit, asked, in_force, measured, low, high, verdict))
    return Findings(rows, known)


def _notes(way: str, found: Mapping[str, Any], finding: Findings) -> Iterator[str]:
    """Note what was not judged, and how much longer it takes."""
    rows = {row["quantity"]: row for row in found["rows"]}
    judged = {row.name for row in finding.rows}
    if not judged and "time_line" not in rows:
        hint = "fly a mission first" if way == "downlink" else "is the other end ready?"
        yield f"{way}: no datagrams to measure; {hint}"
    elif "round_trip" in judged:
        yield f"{way}: the ends do not share a clock: judged by round trips, not one-way delays"
    elif judged and "mean" not in judged:
        yield f"{way}: delays {NOT_JUDGED}: the ends do not share a clock"
    if "rate" in rows and "rate" not in judged:
        yield f"{way}: rate {NOT_JUDGED}: single datagrams do not measure it"
    if "correlation" in rows:
        yield on_correlation(way, rows["correlation"]["asked"])
    if "time_line" in rows:
        yield f"{way}: its time line {NOT_JUDGED} in flight, only what follows it"
    yield from _patience(way, found)


def _patience(way: str, found: Mapping[str, Any]) -> Iterator[str]:
    for row in found["rows"]:
        if found["verdict"] == "open" and row["quantity"] == "datagrams":
            needs, count = round(row["asked"]), round(row["measured"])
            seconds = max(0, needs - count) * PERIOD
            yield f"{way}: {count} of {needs} datagrams, {seconds:.0f} s more"


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
