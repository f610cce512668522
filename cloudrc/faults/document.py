"""The results of a run of faults: as JSON, as JUnit and as a page of Markdown."""

from __future__ import annotations

import xml.etree.ElementTree as Xml
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, NamedTuple

from cloudrc import __version__
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


TITLES: dict[Mode, str] = {
    "virtual": "Faults in virtual time",
    "real": "Faults with real processes, signals and sockets",
    "cluster": "Faults in a Kubernetes cluster",
}
COLUMNS = """
| fault | what is done | what has to follow | what is lost | what the user sees | checks |
|---|---|---|---|---|---|
"""


def as_markdown(results: Sequence[Result], seed: int, mode: Mode) -> str:
    """Lay out the results as a page: a table of the faults, then what was measured.

    Args:
        results: Of the run.
        seed: Of the run.
        mode: Of all of them.
    """
    passed = sum(result.passed for result in results)
    skipped = sum(bool(result.outcome.skipped) for result in results)
    told = f"Seed {seed}, cloudrc {__version__}: {passed} of {len(results) - skipped} passed"
    lines = [f"# {TITLES[mode]}\n\n{told}{f', {skipped} not run' if skipped else ''}.\n", COLUMNS]
    lines += [*map(_row, results), "\n## Measured\n"]
    for result in results:
        lines.append(f"\n### {result.scenario.id} {result.scenario.name}: {result.word}\n\n")
        if result.outcome.sha256:
            lines.append(f"Records, SHA-256: `{result.outcome.sha256[:16]}`\n\n")
        lines += [f"- {line}\n" for line in _measured(result)]
    return "".join(lines)


def _row(result: Result) -> str:
    """A row of the table."""
    scenario, outcome = result.scenario, result.outcome
    good = sum(check.passed for check in outcome.checks)
    checks = outcome.skipped or f"{good} of {len(outcome.checks)} passed"
    name = f"{scenario.id} {scenario.name}"
    cells = (name, scenario.injects, scenario.expects, scenario.loses, scenario.shows, checks)
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
    ] + [text for text in (result.error, result.outcome.skipped) if text]
