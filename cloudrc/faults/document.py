"""The results of a run as JUnit, as JSON and as the table of the documentation."""

from __future__ import annotations

import xml.etree.ElementTree as Xml
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, NamedTuple

from cloudrc import __version__
from cloudrc.faults.scenario import Mode, Outcome, Scenario
from cloudrc.report.document import environment_document


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


HEADS: dict[Mode, str] = {
    "virtual": """\
# Faults: what is done, what has to follow, what was measured

Written by `make faults` (`cloudrc faults run --all --document docs/safety/faults.md`); do not edit.
{result} Each is one command: `cloudrc faults run F13`.
These run in virtual time, with the ends, the driver, the keys and the journal of production. Of a
promise that is checked several times, the worst value is shown. Of every metric that is named it is
said below how it was looked at: that it moves within 5 s of the fault, or of its end where who
stands still shows nothing before; or what it reads. What teleop's API and journal refuse and mend
is no part of a flight: there the count was looked at, not when it shows. What makes sense elsewhere
is brought about there, too: [with real processes](faults-real.md), where F31 is, which takes
sockets, and [in a Kubernetes cluster](faults-cluster.md). All faults together, at random:
[search](search.md), and with a cloud that wants a breach: [adversary](adversary.md). Promises:
[P-FAULT-1] that all pass, [P-FAULT-5] that a seed is a run.
The hashes of the records are those of
{built}: others may round otherwise.
""",
    "real": """\
# Faults with real processes, signals and sockets

Written by `make nightly` (`cloudrc faults run --all --real --document docs/safety/faults-real.md`);
do not edit. {result} Each is one command:
`cloudrc faults run F13 --real`. Times are those of the machine that it ran on. Some are run before
every change lands, too. The others, in virtual time: [faults](faults.md).
""",
    "cluster": """\
# Faults in a Kubernetes cluster

Written by `make e2e-full` (`cloudrc faults run --all --cluster --document
docs/safety/faults-cluster.md`); do not edit. {result}
Each is one command, beside a release that flies nothing: `cloudrc faults run F13 --cluster`. Times
are those of the machine that it ran on. The others, in virtual time: [faults](faults.md).
""",
}
COLUMNS = """
| fault | what is done | what has to follow | what is lost | what the user sees | checks |
|---|---|---|---|---|---|
"""


def built() -> str:
    """What the records of a seed depend on beside cloudrc: what computes their numbers."""
    here = environment_document()
    versions = " and ".join(f"{name} {here['packages'][name]}" for name in ("mujoco", "numpy"))
    return f"{versions} on {here['processor']}, {here['architecture']}"


def as_markdown(results: Sequence[Result], seed: int, mode: Mode, sources: str) -> str:
    """The page of the documentation on the faults of a mode.

    Args:
        results: Of the run.
        seed: Of the run.
        mode: Of all of them.
        sources: Hash of what was run.
    """
    passed = sum(result.passed for result in results)
    skipped = sum(bool(result.outcome.skipped) for result in results)
    told = f"Seed {seed}: {passed} of {len(results)} scenarios passed."
    if skipped:
        told = (
            f"Seed {seed}: {passed} of {len(results) - skipped} run passed, {skipped} not run yet."
        )
    head = HEADS[mode].format(result=told, built=built())
    lines = [head, COLUMNS, *map(_row, results), "\n## Measured\n"]
    for result in results:
        lines.append(f"\n### {result.scenario.id} {result.scenario.name}: {result.word}\n\n")
        if result.outcome.sha256:
            lines.append(f"Records, SHA-256: `{result.outcome.sha256[:16]}`\n\n")
        lines += [f"- {line}\n" for line in _measured(result)]
    lines.append(f"\nRun by cloudrc {__version__}; SHA-256 of its sources: `{sources[:16]}`.\n")
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
