"""The link of a release in flight: both ends are asked what they hear; a verdict goes out.

The tunnel's own datagrams are the probes, so that nothing but the shaped flow is measured. Each end
judges the direction that it hears and serves the rows at /link.json of its metrics port; there the
link containers say who shapes, by what, and which qdiscs are near, in metrics what has passed.
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
    Said,
    on_correlation,
    on_deviation,
    on_jitter,
    on_patience,
)
from cloudrc.cluster.pods import DIRECTLY, METRICS
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
LOOK_PERIOD = 2.0
"""Between two questions [s]."""
OTHER_LIMIT = 30.0
"""Once one direction is off, what the other is may tell why, and is waited for so long [s]."""
_PATIENCE = 3.0
_SENT_MIN = 1500
_SHARES = ("loss", "reordered", "duplicated")
_FLIES = {"uplink": Kind.TELEMETRY, "downlink": Kind.COMMAND}

Tell = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Pod:
    """Where an end and its link container answer: URLs without a path."""

    end: str
    link: str


def verify_ends(pods: Mapping[str, Pod], title: str, limit: float, tell: Tell) -> Said:
    """Wait until both ends have a verdict.

    Args:
        pods: "world" and "cloud".
        title: Names the release.
        limit: How long to wait [s].
        tell: Hears what is going on.

    Raises:
        TimedOutError: If an end cannot be asked within the time.
    """
    hears = {"uplink": "cloud", "downlink": "world"}
    sends = {"uplink": "world", "downlink": "cloud"}
    until, off_until, seen = time.monotonic() + limit, inf, dict[str, dict[str, Any]]()
    before = {way: _counters(pods[end], way) for way, end in sends.items()}
    while True:
        tell(", ".join(_progress(way, seen.get(way, {})) for way in hears))
        time.sleep(LOOK_PERIOD)
        seen |= {way: found for way, end in hears.items() if (found := _ask(pods[end]))}
        verdicts = {way: found["verdict"] for way, found in seen.items()}
        if len(seen) == len(hears) and "open" not in verdicts.values():
            break
        off = len(seen) == len(hears) and "off" in verdicts.values()
        off_until = min(off_until, time.monotonic() + OTHER_LIMIT) if off else inf
        if time.monotonic() > min(until, off_until):
            break
    tell("")
    silent = [end for way, end in hears.items() if way not in seen]
    if silent:
        raise TimedOutError(
            f"{' and '.join(silent)} could not be asked within {limit:g} s: are the pods ready?"
        )
    findings = {
        way: _findings(seen[way], way, before[way], _counters(pods[end], way), _told(pods[end]))
        for way, end in sends.items()
    }
    names = sorted({one.evidence.shaper or "nobody knows" for one in findings.values()})
    return Said(
        title=title,
        shaper=f"shaped by {' and '.join(names)}",
        findings=findings,
        probes={way: _describe(seen[way]) for way in hears},
        notes=[note for way in hears for note in _notes(way, seen[way], findings[way])],
        causes=find_causes(findings),
        more="too few datagrams yet: the ends go on judging, ask again (above: when)",
    )


def _ask(pod: Pod) -> dict[str, Any] | None:
    """What an end thinks of the direction that it hears; None if it does not answer."""
    try:
        found: dict[str, Any] = json.loads(_get(f"{pod.end}/link.json"))
    except (OSError, ValueError):
        return None
    return found


def _get(url: str) -> str:
    with DIRECTLY.open(url, timeout=_PATIENCE) as page:
        return str(page.read().decode())


class _Counters(NamedTuple):
    """What has been counted of a direction: sent by its end; and all that its link tells."""

    sent: int | None
    link: Samples


def _counters(sender: Pod, way: str) -> _Counters:
    """Ask the end that sends and the link that shapes it; what does not answer tells nothing."""
    try:
        ours, link = samples(_get(f"{sender.end}/metrics")), samples(_get(f"{sender.link}/metrics"))
    except OSError:
        return _Counters(None, {})
    sent = ours.get(("cloudrc_datagrams_total", f'direction="{way}",outcome="sent"'))
    return _Counters(None if sent is None else int(sent), link)


def _told(sender: Pod) -> Told | None:
    """Ask the link of a pod what it says of itself; None if it does not."""
    try:
        return read_told(_get(f"{sender.link}/link.json"))
    except (OSError, ValueError):
        return None


def _findings(
    found: Mapping[str, Any], way: str, before: _Counters, after: _Counters, told: Told | None
) -> Findings:
    """Join what one end heard with what the other's link container tells."""
    known = of_told(told) if told else Evidence(shaper=shaper_of(after.link, way))
    known = of_metrics(after.link, 0, known, before.link)
    earlier = of_metrics(before.link, 0, known).passed
    sent = after.sent - before.sent if after.sent and before.sent else 0
    passed = known.passed - earlier if known.passed and earlier else None
    # Counts are told once a second each, so that few say nothing.
    enough = sent >= _SENT_MIN and passed is not None
    known = replace(
        known,
        sent=sent if enough else None,
        passed=passed if enough else None,
        unread=None,  # since it began: long ago
    )
    applied = shown(known.applied, SIZES[_FLIES[way]], known.shaper) if known.applied else {}
    rows = _rows(found, applied)
    told_of = {row["quantity"] for row in found["rows"]}  # a time line may have had other rates
    if (asked := _rate_asked(found)) and known.applied and "time_line" not in told_of:
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
        unit, says = "1" if name in _SHARES else "s", applied.get(name, nan)
        rows.append(Row(name, unit, asked, says, measured, low, high, row["verdict"]))
    return rows


def _rate_asked(found: Mapping[str, Any]) -> float | None:
    """Look up what an end asks of the bottleneck [bit/s]; None without one."""
    rates = (float(row["asked"]) for row in found["rows"] if row["quantity"] == "rate")
    return next(rates, None)


def _describe(found: Mapping[str, Any]) -> str:
    counts = [int(row["datagrams"]) for row in found["rows"]]
    return f"{max(counts, default=0)} of the tunnel's own datagrams"


def _notes(way: str, found: Mapping[str, Any], finding: Findings) -> list[str]:
    if not found["rows"]:
        what = "commands" if way == "downlink" else "telemetry"
        hint = "fly a mission first" if way == "downlink" else "is the other end ready?"
        return [f"{way}: no {what} to judge it by, or its profile changes by itself; {hint}"]
    rows = {str(row["quantity"]): row for row in found["rows"]}
    notes = []
    if rows.get("round_trip", _TOLD)["verdict"] != "told":
        notes.append(f"{way}: the ends do not share a clock: round trips are judged, not one way")
    elif "mean" not in rows and "loss" in rows:
        notes.append(f"{way}: delays {NOT_JUDGED}: the ends do not share a clock")
    asked, judged = _rate_asked(found), any(row.name == "rate" for row in finding.rows)
    if asked and not judged:
        applied = finding.evidence.applied
        says = f" (applied: {kbit(applied.rate or inf)})" if applied else ""
        notes.append(f"{way}: rate of {kbit(asked)}{says} {NOT_JUDGED}: its datagrams come alone")
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
    if "time_line" in rows and (share := float(rows["time_line"]["measured"])) < _WATCHED:
        notes.append(
            f"{way}: of its time line {share:.0%} was watched and as asked, the rest {NOT_JUDGED}; "
            "'cloudrc link set --profile' starts it anew"
        )
    return notes + _needed(way, found)


_TOLD: Mapping[str, str] = {"verdict": "told"}
_WATCHED = 0.85
"""A time line of which so much was seen is as good as seen: a session takes 2 s to settle."""


def _progress(way: str, found: Mapping[str, Any]) -> str:
    """Say in a few words how far an end is."""
    needed = _needed(way, found)
    return needed[0] if needed else f"{way}: {found.get('verdict', 'silent')}"


def _needed(way: str, found: Mapping[str, Any]) -> list[str]:
    """Say how long it takes, if there is no verdict yet."""
    rows = {row["quantity"]: row for row in found.get("rows", ())}
    if found.get("verdict") != "open" or "datagrams" not in rows:
        return []
    needs, there = int(rows["datagrams"]["asked"]), int(rows["datagrams"]["measured"])
    seconds = max(0, needs - there) * PERIOD
    return [f"{way}: {there} of {needs} datagrams, {seconds:.0f} s more"]
