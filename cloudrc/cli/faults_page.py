"""The result of a search for faults: as a table, in a sentence, as a page of the documentation."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from typing import Any

from cloudrc.cli.output import harmless

INVARIANTS = {
    "collision": "collisions",
    "fence": "fence breaches",
    "cap": "cap breaches",
    "stop": "too fast towards the fence",
    "stale": "motion on stale commands",
    "rest": "motion long after the last command",
    "latch": "rotors on without the operator's word",
    "hold": "HOLDs that end too early or too late",
    "tick": "steps without the guard",
    "obeyed": "emergency stops that were not obeyed",
    "order": "commands applied out of order",
    "waypoint": "waypoints reached out of order, or twice",
    "stuck": "stuck states",
    "alarm": "false alarms",
    "recording": "recordings that do not hold what happened",
    "error": "errors in an end",
}
PROMISES = {"random": "P-FAULT-2", "adversarial": "P-FAULT-3", "clean": "P-FAULT-4"}
"""Ids in `docs/safety/promises.md`."""
NOTES = {
    "random": (
        "",
        "In half of the schedules teleop is a process of its own, as in production: it looks every",
        "20 ms, its sockets take 11 datagrams, and while its journal waits for the disk it neither",
        "hears nor speaks. In every third a HOLD of 0.8 to 3 s ends in LAND, as it does in half",
        "of these; in the others it would take 60 s.",
        "",
        "What is no matter of what comes together has scenarios of its own, by [name](faults.md):",
        "bad orders, orders that come twice, slow readers (F27, F28, F31, F32, F35, F37).",
    ),
    "adversarial": (
        "",
        "The cloud holds valid keys. Every second one flies amid faults of all kinds, and some",
        "speak in the operator's place. A robot that these, or a hit, have stopped may come to lie",
        "outside the fence, a [known limit](guard.md): it is told below the table, and a breach",
        "beyond 1.5 m.",
    ),
}
"""What else is to be said, by kind."""

Slice = tuple[str, dict[str, Any]]
"""Name of a file, and what it holds."""


def rows(document: dict[str, Any]) -> list[tuple[str, ...]]:
    """Each invariant with its bound."""
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
    """How much was flown, and the extremes."""
    fallen, thrown = (
        f"; {document[key]} stopped by {cause} came to lie outside of it, at most "
        f"by {document[f'{key}_m']:.2f} m"
        for key, cause in (("fallen", "the operator's word"), ("thrown", "a hit"))
    )
    landed = f"; {document['landed_on']} came down on something other than the floor"
    return (
        f"{document['hours']:.2f} virtual hours of {document['kind']} schedules from seed "
        f"{document['first']} on in {document['seconds']:.0f} s: "
        f"{document['missions_done']} missions done, {document['holds']} HOLDs, "
        f"nearest to the fence {document['smallest_margin_m']:.3f} m, "
        f"fastest {document['largest_speed_mps']:.2f} m/s"
        + (fallen if document["fallen"] else "")
        + (thrown if document["thrown"] else "")
        + (landed if document["landed_on"] else "")
    )


def command(document: dict[str, Any]) -> str:
    """The command that flies the same once more; where it keeps what it finds changes nothing."""
    kind, first = document["kind"], document["first"]
    words = ["cloudrc faults fuzz", *([f"--{kind}"] if kind != "random" else [])]
    words += [f"--first {first}"] if first != 1 else []
    return " ".join([*words, f"--seeds {document['count']}"])


def _flown(slices: Sequence[Slice]) -> list[str]:
    """Which commands fly the slices: a line for as many of one length as follow each other."""
    lines = ["Flown in slices:", ""]
    for count, each in groupby(slices, key=lambda part: part[1]["count"]):
        (name, first), *others = each
        line = f"- `{command(first)} --slice {name}`"
        if others:
            name, last = others[-1]
            line += f" to `{command(last)} --slice {name}`: {len(others) + 1} of {count} each"
        lines.append(line)
    return [*lines, ""]


def markdown(document: dict[str, Any], written_by: str, slices: Sequence[Slice] = ()) -> str:
    """Lay out a page of the documentation.

    Args:
        document: The result.
        written_by: The command that writes the page.
        slices: The parts it was added up from, by their seeds; none if it was flown at once.
    """
    head, *lines = rows(document)
    kind = document["kind"]
    return "\n".join(
        harmless(line)
        for line in (
            f"# The search for faults: {kind} schedules",
            "",
            f"Written by `{written_by}`;",
            "do not edit. Each schedule is one minute of flight; the",
            "invariants are looked at in every step of 2 ms. The bound is by the rule of three:",
            "0 events in N runs, p < 3/N with 95 % confidence. N counts the schedules in which an",
            "invariant is looked at: under a cloud that means no good a contact is no breach, and",
            "only where nothing goes wrong a HOLD, LAND or ESTOP is a false alarm. The promise is "
            f"[{PROMISES[kind]}].",
            *NOTES.get(kind, ()),
            "",
            f"| {' | '.join(head)} |",
            "|---|---|---|---|",
            *(f"| {' | '.join(line)} |" for line in lines),
            "",
            summary(document) + ".",
            "",
            *(_flown(slices) if slices else ()),
            f"Flown by cloudrc {document['version']}; SHA-256 of its sources: "
            f"`{document['sources'][:16]}`.",
            "",
        )
    )
