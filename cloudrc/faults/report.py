"""Results of fault scenarios and of searches: as JSON, JUnit, a table and a sentence."""

from __future__ import annotations

import xml.etree.ElementTree as Xml
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, NamedTuple

from cloudrc.faults.scenario import Outcome, Scenario

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
    "error": "errors in an end",
}


class Result(NamedTuple):
    """Result of a scenario that was run.

    Attributes:
        scenario: The scenario.
        outcome: Its checks.
        seconds: Duration [s].
        error: Exception that ended the run; "" if none did.
    """

    scenario: Scenario
    outcome: Outcome
    seconds: float
    error: str = ""

    @property
    def passed(self) -> bool:
        """Whether every check passed."""
        return not self.error and self.outcome.passed

    @property
    def word(self) -> str:
        """One word for a table."""
        return "passed" if self.passed else "FAILED"


def as_json(results: Sequence[Result], seed: int) -> dict[str, Any]:
    """Return the results of scenarios as plain values."""
    return {
        "schemaVersion": 1,
        "seed": seed,
        "passed": all(result.passed for result in results),
        "faults": [
            {
                "id": result.scenario.id,
                "name": result.scenario.name,
                "mode": "virtual",
                "result": result.word.lower(),
                "reason": result.error,
                "seconds": round(result.seconds, 3),
                "records_sha256": result.outcome.sha256,
                "checks": [
                    asdict(check) | {"passed": check.passed} for check in result.outcome.checks
                ],
            }
            for result in results
        ],
    }


def as_junit(results: Sequence[Result], seed: int) -> str:
    """Return the results of scenarios as JUnit XML, one test case per fault."""
    suite = Xml.Element(
        "testsuite",
        name=f"cloudrc faults, seed {seed}",
        tests=str(len(results)),
        failures=str(sum(not result.passed for result in results)),
        skipped="0",
    )
    for result in results:
        name = f"{result.scenario.id} {result.scenario.name}"
        case = Xml.SubElement(
            suite, "testcase", classname="faults", name=name, time=f"{result.seconds:.3f}"
        )
        if not result.passed:
            lines = [check.show() for check in result.outcome.checks if not check.passed]
            text = "\n".join(filter(None, [result.error, *lines])) or "it checked nothing"
            Xml.SubElement(case, "failure", message=text.splitlines()[0]).text = text
    Xml.indent(suite)
    return Xml.tostring(suite, encoding="unicode", xml_declaration=True) + "\n"


def search_rows(document: dict[str, Any]) -> list[tuple[str, ...]]:
    """Return a table of a search: each invariant with its upper bound of failure probability.

    The bound is the rule of three: 0 events in N runs mean p < 3/N with 95 % confidence.
    """
    lines: list[tuple[str, ...]] = [("invariant", "broken in", "of N", "95 % bound")]
    for name, words in INVARIANTS.items():
        judged, broken = (document["invariants"][name][each] for each in ("judged", "broken"))
        bound = "not judged" if not judged else "-" if broken else f"p < {min(3 / judged, 1):.2g}"
        lines.append((words, str(broken) if judged else "-", str(judged), bound))
    return lines


def search_summary(document: dict[str, Any]) -> str:
    """Describe in one sentence how much a search flew, and the extreme values."""
    return (
        f"{document['count']} {document['kind']} schedules in {document['seconds']:.0f} s, seeds "
        f"{document['first']} to {document['next'] - 1}, {document['hours']:.2f} virtual hours: "
        f"{len(document['failures'])} broken, {document['missions_done']} missions done, "
        f"{document['holds']} HOLDs, nearest to the fence {document['smallest_margin_m']:.3f} m, "
        f"fastest {document['largest_speed_mps']:.2f} m/s"
    )
