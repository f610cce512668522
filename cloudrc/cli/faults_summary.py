"""Summarise a search for faults as plain values, a table, a sentence or a Markdown page."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from cloudrc import __version__

INVARIANTS = {
    "collision": "collisions",
    "fence": "fence breaches",
    "cap": "cap breaches",
    "stop": "too fast towards the fence",
    "stale": "motion on stale commands",
    "rest": "motion long after the last command",
    "latch": "rotors on without an acknowledgement",
    "hold": "HOLDs that end too early or too late",
    "tick": "steps without the guard",
    "obeyed": "emergency stops without effect",
    "order": "commands applied out of order",
    "waypoint": "waypoints reached out of order, or twice",
    "stuck": "stuck states",
    "alarm": "false alarms",
    "recording": "incomplete or wrong recordings",
    "error": "errors in an end",
}


def document(
    findings: Sequence[dict[str, Any]],
    failures: Sequence[dict[str, Any]],
    *,
    kind: str,
    first: int,
    seconds: float,
) -> dict[str, Any]:
    """Summarise flights as plain values.

    Args:
        findings: Short result of each flight.
        failures: Flights that broke an invariant, with their reduced schedules.
        kind: "random", "adversarial" or "clean".
        first: Seed of the first flight.
        seconds: Duration of the search [s].
    """
    return {
        "schemaVersion": 1,
        "kind": kind,
        "first": first,
        "count": len(findings),
        "version": __version__,
        "hours": sum(each["duration"] for each in findings) / 3600.0,
        "seconds": seconds,
        "invariants": {name: _judge(name, findings) for name in INVARIANTS},
        "smallest_margin_m": min((each["margin"] for each in findings), default=0.0),
        "largest_speed_mps": max((each["speed"] for each in findings), default=0.0),
        "holds": sum(each["holds"] for each in findings),
        "missions_done": sum(each["missions"] for each in findings),
        "fallen": sum(each["fallen"] > 0.0 for each in findings),
        "thrown": sum(each["thrown"] > 0.0 for each in findings),
        "landed_on": sum(each["landed_on"] for each in findings),
        "fallen_m": max((each["fallen"] for each in findings), default=0.0),
        "thrown_m": max((each["thrown"] for each in findings), default=0.0),
        "failures": list(failures),
    }


def _judge(name: str, findings: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Count the flights in which an invariant was checked, and those in which it broke."""
    judged = sum(name in each["judged"] for each in findings)
    broken = sum(name in each["kinds"] for each in findings)
    # Rule of three: 0 events in N runs mean p < 3/N with 95 % confidence.
    bound = min(3.0 / judged, 1.0) if judged and not broken else None
    return {"judged": judged, "broken": broken if judged else None, "bound": bound}


def rows(document: dict[str, Any]) -> list[tuple[str, ...]]:
    """Lay out a table: each invariant with its upper bound of failure probability."""
    lines: list[tuple[str, ...]]
    lines = [("invariant", "broken in", "of N", "95 % bound")]
    for kind, words in INVARIANTS.items():
        broken, judged, bound = (
            document["invariants"][kind][name] for name in ("broken", "judged", "bound")
        )
        if not judged:
            lines.append((words, "-", "0", "not judged"))
            continue
        lines.append((words, str(broken), str(judged), "-" if broken else f"p < {bound:.2g}"))
    return lines


def summary(document: dict[str, Any]) -> str:
    """Describe in one sentence how much was flown, and the extreme values."""
    fallen, thrown = (
        f"; {document[key]} came to rest outside of it after {cause}, at most "
        f"by {document[f'{key}_m']:.2f} m"
        for key, cause in (("fallen", "an emergency stop"), ("thrown", "a collision"))
    )
    landed = f"; {document['landed_on']} landed on something other than the floor"
    return (
        f"{document['hours']:.2f} virtual hours of {document['kind']} schedules, first seed "
        f"{document['first']}, in {document['seconds']:.0f} s: "
        f"{document['missions_done']} missions done, {document['holds']} HOLDs, "
        f"nearest to the fence {document['smallest_margin_m']:.3f} m, "
        f"fastest {document['largest_speed_mps']:.2f} m/s"
        + (fallen if document["fallen"] else "")
        + (thrown if document["thrown"] else "")
        + (landed if document["landed_on"] else "")
    )


def command(document: dict[str, Any]) -> str:
    """Return the command that repeats this search."""
    kind, first = document["kind"], document["first"]
    words = ["cloudrc faults fuzz", *([f"--{kind}"] if kind != "random" else [])]
    words += [f"--first {first}"] if first != 1 else []
    return " ".join([*words, f"--seeds {document['count']}"])


def markdown(document: dict[str, Any], written_by: str) -> str:
    """Lay out the result as a page.

    Args:
        document: The result.
        written_by: The command that writes the page.
    """
    head, *lines = rows(document)
    return "\n".join(
        (
            f"# The search for faults: {document['kind']} schedules",
            "",
            f"Written by `{written_by}` with cloudrc {document['version']}. Each schedule is one",
            "minute of flight; each step of 2 ms is checked. N counts the schedules to which an",
            "invariant applies. The bound is the rule of three: 0 events in N runs mean p < 3/N",
            "with 95 % confidence.",
            "",
            f"| {' | '.join(head)} |",
            "|---|---|---|---|",
            *(f"| {' | '.join(line)} |" for line in lines),
            "",
            summary(document) + ".",
            "",
        )
    )
