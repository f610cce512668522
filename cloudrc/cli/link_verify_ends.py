"""Verify the link of a release in flight, from what its pods report over HTTP.

The tunnel's own datagrams are the probes, so only the shaped flow is measured. Each end judges the
direction that it receives and serves the result at /link.json of its metrics port. There the link
containers report the shaper, its settings and the qdiscs of the pod; their metrics count datagrams.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from math import inf, nan
from typing import Any, NamedTuple

from cloudrc.cli.link_verify_text import (
    NOT_JUDGED,
    VerifyReport,
    on_correlation,
    on_deviation,
    on_jitter,
    on_patience,
)
from cloudrc.cluster.pods import METRICS, NO_PROXY
from cloudrc.errors import TimedOutError
from cloudrc.link.sidecar import Told, read_told
from cloudrc.link.verify.causes import (
    Evidence,
    Findings,
    Samples,
    find_causes,
    of_metrics,
    of_told,
    samples,
    shaper_of,
)
from cloudrc.link.verify.judge import Row, kbit
from cloudrc.link.verify.monitor import TAKES
from cloudrc.link.verify.standing import PERIOD, rate_in_force, shown
from cloudrc.tunnel.codec import SIZES, Kind

END_PORT, LINK_PORT = METRICS["world"]["world"], METRICS["world"]["link"]
POLL_PERIOD = 2.0
"""Pause between two polls of the ends [s]."""
SECOND_VERDICT_TIMEOUT = 30.0
"""Longest wait for the second verdict once the first is "off" [s]; the two verdicts together help
to find the cause."""
_HTTP_TIMEOUT = 3.0
_SENT_MIN = 1500  # counts of fewer datagrams are too inexact to compare
_SHARES = ("loss", "reordered", "duplicated")
_KINDS = {"uplink": Kind.TELEMETRY, "downlink": Kind.COMMAND}

Tell = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Pod:
    """URLs of an end and of its link container, without a path."""

    end: str
    link: str


def verify_ends(pods: Mapping[str, Pod], title: str, limit: float, tell: Tell) -> VerifyReport:
    """Wait for the verdicts of both ends and combine them.

    Args:
        pods: "world" and "cloud".
        title: Name of the release.
        limit: Time to wait [s].
        tell: Receives progress as text.

    Raises:
        TimedOutError: If an end does not answer in time.
    """
    receiver = {"uplink": "cloud", "downlink": "world"}
    sender = {"uplink": "world", "downlink": "cloud"}
    deadline, off_deadline, seen = time.monotonic() + limit, inf, dict[str, dict[str, Any]]()
    before = {way: _counters(pods[end], way) for way, end in sender.items()}
    while True:
        tell(", ".join(_progress(way, seen.get(way, {})) for way in receiver))
        time.sleep(POLL_PERIOD)
        seen |= {way: found for way, end in receiver.items() if (found := _ask(pods[end]))}
        verdicts = {way: found["verdict"] for way, found in seen.items()}
        if len(seen) == len(receiver) and "open" not in verdicts.values():
            break
        off = len(seen) == len(receiver) and "off" in verdicts.values()
        off_deadline = min(off_deadline, time.monotonic() + SECOND_VERDICT_TIMEOUT) if off else inf
        if time.monotonic() > min(deadline, off_deadline):
            break
    tell("")
    silent = [end for way, end in receiver.items() if way not in seen]
    if silent:
        raise TimedOutError(
            f"{' and '.join(silent)} did not answer within {limit:g} s: are the pods ready?"
        )
    findings = {
        way: _findings(seen[way], way, before[way], _counters(pods[end], way), _status(pods[end]))
        for way, end in sender.items()
    }
    names = sorted({one.evidence.shaper or "an unknown shaper" for one in findings.values()})
    return VerifyReport(
        title=title,
        shaper=f"shaped by {' and '.join(names)}",
        findings=findings,
        probes={way: _describe(seen[way]) for way in receiver},
        notes=[note for way in receiver for note in _notes(way, seen[way], findings[way])],
        causes=find_causes(findings),
        more="too few datagrams so far: the ends continue to measure; ask again (time: above)",
    )


def _ask(pod: Pod) -> dict[str, Any] | None:
    """Fetch an end's verdict on the direction that it receives; None without an answer."""
    try:
        found: dict[str, Any] = json.loads(_get(f"{pod.end}/link.json"))
    except (OSError, ValueError):
        return None
    return found


def _get(url: str) -> str:
    with NO_PROXY.open(url, timeout=_HTTP_TIMEOUT) as page:
        return str(page.read().decode())


class _Counters(NamedTuple):
    """Counters of a direction: datagrams sent by its end, and the metrics of its link."""

    sent: int | None
    link: Samples


def _counters(sender: Pod, way: str) -> _Counters:
    """Fetch the counters of a direction from the sending pod; empty without an answer."""
    try:
        end, link = samples(_get(f"{sender.end}/metrics")), samples(_get(f"{sender.link}/metrics"))
    except OSError:
        return _Counters(None, {})
    sent = end.get(("cloudrc_datagrams_total", f'direction="{way}",outcome="sent"'))
    return _Counters(None if sent is None else int(sent), link)


def _status(sender: Pod) -> Told | None:
    """Fetch the status of a pod's link container; None without an answer."""
    try:
        return read_told(_get(f"{sender.link}/link.json"))
    except (OSError, ValueError):
        return None


def _findings(
    found: Mapping[str, Any], way: str, before: _Counters, after: _Counters, status: Told | None
) -> Findings:
    """Combine the receiver's verdict with the evidence of the sender's link container."""
    known = of_told(status) if status else Evidence(shaper=shaper_of(after.link, way))
    known = of_metrics(after.link, 0, known, before.link)
    earlier = of_metrics(before.link, 0, known).passed
    sent = after.sent - before.sent if after.sent and before.sent else 0
    passed = known.passed - earlier if known.passed and earlier else None
    # Both counters are updated once a second: a small difference means nothing.
    enough = sent >= _SENT_MIN and passed is not None
    known = replace(
        known,
        sent=sent if enough else None,
        passed=passed if enough else None,
        unread=None,  # counted since its start, long before this test
    )
    applied = shown(known.applied, SIZES[_KINDS[way]], known.shaper) if known.applied else {}
    rows = _rows(found, applied)
    quantities = {row["quantity"] for row in found["rows"]}  # a time line may change the rate
    if (asked := _rate_asked(found)) and known.applied and "time_line" not in quantities:
        rows += rate_in_force(asked, known.applied.rate or inf)
    return Findings(rows, known)


def _rows(found: Mapping[str, Any], applied: Mapping[str, float]) -> list[Row]:
    rows = []
    for row in found["rows"]:
        if row["verdict"] == "told":
            continue
        name = str(row["quantity"])
        values = [float(row.get(key, nan)) for key in ("asked", "measured", "low", "high")]
        asked, measured, low, high = values
        unit, in_force = "1" if name in _SHARES else "s", applied.get(name, nan)
        rows.append(Row(name, unit, asked, in_force, measured, low, high, row["verdict"]))
    return rows


def _rate_asked(found: Mapping[str, Any]) -> float | None:
    """Return the requested rate of the bottleneck [bit/s]; None without one."""
    rates = (float(row["asked"]) for row in found["rows"] if row["quantity"] == "rate")
    return next(rates, None)


def _describe(found: Mapping[str, Any]) -> str:
    counts = [int(row["datagrams"]) for row in found["rows"]]
    return f"{max(counts, default=0)} of the tunnel's own datagrams"


def _notes(way: str, found: Mapping[str, Any], finding: Findings) -> list[str]:
    if not found["rows"]:
        what = "commands" if way == "downlink" else "telemetry"
        hint = "fly a mission first" if way == "downlink" else "is the other end ready?"
        return [f"{way}: no {what} to measure, or its profile is a time line; {hint}"]
    rows = {str(row["quantity"]): row for row in found["rows"]}
    notes = []
    if rows.get("round_trip", _NO_ROW)["verdict"] != "told":
        notes.append(
            f"{way}: the ends do not share a clock: judged by round trips, not one-way delays"
        )
    elif "mean" not in rows and "loss" in rows:
        notes.append(f"{way}: delays {NOT_JUDGED}: the ends do not share a clock")
    asked, judged = _rate_asked(found), any(row.name == "rate" for row in finding.rows)
    if asked and not judged:
        applied = finding.evidence.applied
        in_force = f" (applied: {kbit(applied.rate or inf)})" if applied else ""
        notes.append(
            f"{way}: rate of {kbit(asked)}{in_force} {NOT_JUDGED}: needs datagrams in trains"
        )
    if "deviation" in rows and not {"variation", "middle"} & rows.keys():
        notes += on_deviation(way, float(rows["deviation"]["asked"]))
    if "jitter_share" in rows:
        notes += on_jitter(way, float(rows["jitter_share"]["measured"]))
    if "correlation" in rows:
        notes += on_correlation(way, float(rows["correlation"]["asked"]))
    for name in rows:
        if name.endswith(TAKES):
            needs = float(rows[name].get("asked", inf))
            notes += on_patience(way, name.removesuffix(TAKES), needs)
    if "time_line" in rows and (share := float(rows["time_line"]["measured"])) < _MEASURED_MIN:
        notes.append(
            f"{way}: {share:.0%} of its time line was measured and correct, the rest {NOT_JUDGED}; "
            "'cloudrc link set --profile' starts it anew"
        )
    return notes + _needed(way, found)


_NO_ROW: Mapping[str, str] = {"verdict": "told"}
_MEASURED_MIN = 0.85
"""Share of a time line above which the whole time line counts as measured [1]: a session needs 2 s
to settle."""


def _progress(way: str, found: Mapping[str, Any]) -> str:
    """Describe the progress of an end in a few words."""
    needed = _needed(way, found)
    return needed[0] if needed else f"{way}: {found.get('verdict', 'silent')}"


def _needed(way: str, found: Mapping[str, Any]) -> list[str]:
    """Describe how much longer it takes, if there is no verdict yet."""
    rows = {row["quantity"]: row for row in found.get("rows", ())}
    if found.get("verdict") != "open" or "datagrams" not in rows:
        return []
    needs, count = int(rows["datagrams"]["asked"]), int(rows["datagrams"]["measured"])
    seconds = max(0, needs - count) * PERIOD
    return [f"{way}: {count} of {needs} datagrams, {seconds:.0f} s more"]
