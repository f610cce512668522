"""Verify the link of a release in flight, from what its pods report over HTTP.

The tunnel's own datagrams are the probes. Each end judges the direction that it receives and serves
the result at /link.json of its metrics port; there each link container shows what it shapes.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from math import inf, nan
from typing import Any, TypeAlias

import numpy as np

from cloudrc.cli.link_verify_report import NOT_JUDGED, Report, make_report, on_correlation
from cloudrc.cluster.pods import METRICS, NO_PROXY
from cloudrc.errors import TimedOutError
from cloudrc.link.profile import DirectionProfile
from cloudrc.link.sidecar import Told, read_told
from cloudrc.link.verify.causes import Findings, Metrics, read_evidence, read_metrics
from cloudrc.link.verify.expect import RUN_LENGTH, Flow, Plan
from cloudrc.link.verify.judge import UNITS, Row, tolerance
from cloudrc.link.verify.monitor import PERIOD
from cloudrc.tunnel.codec import SIZES, Kind

END_PORT, LINK_PORT = METRICS["world"]["world"], METRICS["world"]["link"]
POLL_PERIOD, OFF_TIMEOUT, HTTP_TIMEOUT = 2.0, 30.0, 3.0
"""Pause between two polls, longest wait for a verdict once the other is "off", for a page [s]."""
SENT_MIN = 1500
"""Counts of fewer datagrams are too inexact to compare [1]: they are updated once a second."""
WAYS = {
    "uplink": ("world", "cloud", Kind.TELEMETRY),
    "downlink": ("cloud", "world", Kind.COMMAND),
}
"""Direction -> the end that sends in it, the end that receives, and what."""

Pods: TypeAlias = Mapping[str, Sequence[str]]
"""End -> URLs of its own pages and of those of its link container."""


def verify(title: str, pods: Pods, limit: float, tell: Callable[[str], None]) -> Report:
    """Wait at most `limit` [s] for the verdicts of both ends.

    Raises:
        TimedOutError: If an end does not answer in time.
    """
    deadline, off_deadline = time.monotonic() + limit, inf
    before, seen = {way: _counters(way, pods) for way in WAYS}, dict[str, Any]()
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
    findings = {way: _findings(way, seen[way], pods, *before[way]) for way in WAYS}
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


def _counters(way: str, pods: Pods) -> tuple[float, Metrics]:
    """Fetch how many datagrams a direction's end has sent, and the metrics of its link."""
    end, link = (read_metrics(fetch(f"{url}/metrics")) for url in pods[WAYS[way][0]])
    return end.get(f"cloudrc_datagrams_total/{way}/sent", nan), link


def _findings(
    way: str, found: Mapping[str, Any], pods: Pods, before: float, metrics: Metrics
) -> Findings:
    """Combine the receiver's verdict with what the sender's link reports."""
    sender, _, kind = WAYS[way]
    total, now = _counters(way, pods)
    try:
        told = read_told(fetch(f"{pods[sender][1]}/link.json"))
    except ValueError:
        told = Told("", "", None)
    sent = round(total - before) if total - before >= SENT_MIN else None
    known = read_evidence(told, now, sent, metrics)
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
    if not rows:
        hint = "fly a mission first" if way == "downlink" else "is the other end ready?"
        yield f"{way}: no datagrams to measure; {hint}"
    elif "round_trip" in judged:
        yield f"{way}: the ends do not share a clock: judged by round trips, not one-way delays"
    elif "mean" not in judged:
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
