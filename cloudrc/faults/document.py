"""The results of a run as JUnit, as JSON and as the table of the documentation."""

from __future__ import annotations

import xml.etree.ElementTree as Xml
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, NamedTuple

from cloudrc.faults.catalogue import scenarios
from cloudrc.faults.scenario import Mode, Outcome, Scenario


class Result(NamedTuple):
    """A scenario that was run.

    Attributes:
        scenario: Which.
        outcome: What it showed.
        seconds: How long it took [s].
        error: What broke the run itself; "" if nothing did.
    """

    scenario: Scenario
    outcome: Outcome
    seconds: float
    error: str = ""

    @property
    def passed(self) -> bool:
        """Whether it was run and every check passed."""
        return not self.error and not self.outcome.skipped and self.outcome.passed

    @property
    def failed(self) -> bool:
        """Whether it was run and did not pass."""
        return not self.passed and not self.outcome.skipped

    @property
    def word(self) -> str:
        """One word for a table."""
        return "skipped" if self.outcome.skipped else "passed" if self.passed else "FAILED"


def as_json(results: Sequence[Result], seed: int) -> dict[str, Any]:
    """Everything, for programs."""
    return {
        "schemaVersion": 1,
        "seed": seed,
        "passed": not any(result.failed for result in results),
        "faults": [
            {
                "id": result.scenario.id,
                "name": result.scenario.name,
                "mode": result.scenario.mode,
                "result": result.word.lower(),
                "reason": result.error or result.outcome.skipped,
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
    """As CI systems read it: one test case per fault."""
    suite = Xml.Element(
        "testsuite",
        name=f"cloudrc faults, seed {seed}",
        tests=str(len(results)),
        failures=str(sum(result.failed for result in results)),
        skipped=str(sum(bool(result.outcome.skipped) for result in results)),
    )
    for result in results:
        scenario, outcome = result.scenario, result.outcome
        case = Xml.SubElement(
            suite,
            "testcase",
            classname=f"faults.{scenario.mode}",
            name=f"{scenario.id} {scenario.name}",
            time=f"{result.seconds:.3f}",
        )
        if outcome.skipped:
            Xml.SubElement(case, "skipped", message=outcome.skipped)
        elif not result.passed:
            lines = [check.show() for check in outcome.checks if not check.passed]
            text = "\n".join(filter(None, [result.error, *lines])) or "it checked nothing"
            Xml.SubElement(case, "failure", message=text.splitlines()[0]).text = text
    Xml.indent(suite)
    return Xml.tostring(suite, encoding="unicode", xml_declaration=True) + "\n"


HEAD = """\
# Faults: what is done, what has to follow, what was measured

Written by `make faults` (`cloudrc faults run --all --document docs/safety/faults.md`); do not edit.
Seed {seed}: {passed} of {count} scenarios passed. Each is one command: `cloudrc faults run F13`.
These run in virtual time, with the ends, the driver, the keys and the journal of production. Of a
promise that is checked several times, the worst value is shown. A metric that is named has to read
otherwise within 5 s. What makes sense with real processes and in a cluster is listed below. All
faults together, at random: [search](search.md), and with a cloud that wants a breach:
[adversary](adversary.md). Promises: [P-FAULT-1] that all pass, [P-FAULT-5] that a seed is a run.

| fault | what is done | what has to follow | what is lost | what the user sees | checks |
|---|---|---|---|---|---|
"""
ELSEWHERE: dict[Mode, str] = {
    "real": """
## With real processes, signals and sockets

`cloudrc faults run --all --real`; some before every change lands, all by `make nightly`.

""",
    "cluster": """
## In a Kubernetes cluster

`cloudrc faults run --all --cluster`, beside a release that flies nothing.

""",
}
COLUMNS = """\
| fault | what is done | what has to follow | what is lost | what the user sees |
|---|---|---|---|---|
"""


def as_markdown(results: Sequence[Result], seed: int) -> str:
    """The table of the documentation."""
    passed = sum(result.passed for result in results)
    lines = [HEAD.format(seed=seed, passed=passed, count=len(results))]
    for scenario, outcome, *_ in results:
        good = sum(check.passed for check in outcome.checks)
        lines.append(_row(scenario, outcome.skipped or f"{good} of {len(outcome.checks)} passed"))
    for mode, head in ELSEWHERE.items():
        lines += [head, COLUMNS, *map(_row, scenarios(mode))]
    lines.append("\n## Measured\n")
    for result in results:
        lines.append(f"\n### {result.scenario.id} {result.scenario.name}: {result.word}\n\n")
        if result.outcome.sha256:
            lines.append(f"Records, SHA-256: `{result.outcome.sha256[:16]}`\n\n")
        lines += [f"- {line}\n" for line in _measured(result)]
    return "".join(lines)


def _row(scenario: Scenario, *more: str) -> str:
    """A row of a table."""
    name = f"{scenario.id} {scenario.name}"
    cells = (name, scenario.injects, scenario.expects, scenario.loses, scenario.shows, *more)
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |\n"


def _measured(result: Result) -> list[str]:
    """Each promise once: the worst of its values, and how often it was checked."""
    lines: dict[str, str] = {}
    worst: dict[str, tuple[bool, float]] = {}
    counts: dict[str, int] = {}
    for check in result.outcome.checks:
        counts[check.text] = counts.get(check.text, 0) + 1
        bad = -check.measured if check.relation == ">=" else check.measured
        key = (not check.passed, bad)
        if check.text not in worst or key > worst[check.text]:
            worst[check.text] = key
            lines[check.text] = check.show()
    return [
        line + (f", {counts[text]} times" if counts[text] > 1 else "")
        for text, line in lines.items()
    ] + ([result.error] if result.error else [])
