"""Write the results of `make nightly` as index.md, numbers.json and environment.json.

`make nightly` runs this module last, on the folder with the results of the tests, `cloudrc faults`,
mutmut and the link benchmark. Commands that did not run are left out.
"""

from __future__ import annotations

import json
import subprocess
import sys
import xml.etree.ElementTree as Xml
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from cloudrc.faults.search import search_rows, search_summary
from cloudrc.report.document import environment_document, write_json
from tools.docs import table

Rows = Iterable[Iterable[object]]


def environment() -> dict[str, Any]:
    """Describe the commit and the machine."""
    git = ["git", "describe", "--always", "--abbrev=40", "--dirty", "--exclude=*"]
    commit = subprocess.run(git, capture_output=True, text=True).stdout.strip()
    return {"commit": commit or "unknown", **environment_document()}


def read(folder: Path, names: str) -> Iterator[dict[str, Any]]:
    """Read the JSON files that match `names`; skip empty files of commands that failed."""
    for path in sorted(folder.glob(names)):
        if text := path.read_text(encoding="utf-8"):
            yield json.loads(text)


def numbers(folder: Path) -> list[dict[str, Any]]:
    """Find the worst measurement of each recorded number, and count its measurements."""
    groups: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for path in sorted(folder.glob("numbers/*.jsonl")):
        for row in map(json.loads, path.read_text(encoding="utf-8").splitlines()):
            groups[row["name"]].append(row)
    return [
        max(group, key=_badness) | {"count": sum(row["count"] for row in group)}
        for _, group in sorted(groups.items())
    ]


def _badness(row: dict[str, Any]) -> float:
    """Rate a measurement: the larger, the worse; a missing measurement is the worst."""
    if row["measured"] is None:
        return float("inf")
    badness = row["measured"] - row["asked"]
    return float({"<=": badness, ">=": -badness, "==": abs(badness)}[row["relation"]])


def number_rows(found: list[dict[str, Any]]) -> Rows:
    """Yield a table row for each number."""
    for row in found:
        measured = "-" if row["measured"] is None else f"{row['measured']:.4g} {row['unit']}"
        asked = f"{row['relation']} {row['asked']:g} {row['unit']}"
        yield row["name"], asked, measured, f"{row['count']:,}", row["test"].partition("::")[0]


def test_rows(folder: Path) -> Rows:
    """Count the tests of each run of pytest."""
    for path in sorted(folder.glob("*.xml")):
        for suite in Xml.parse(path).iter("testsuite"):
            yield path.stem, *map(suite.get, ("tests", "failures", "errors", "skipped"))


def fault_rows(folder: Path) -> Rows:
    """List the injected faults, and the checks that failed."""
    for each in (each for run in read(folder, "faults*.json") for each in run["faults"]):
        failed = [check["text"] for check in each["checks"] if not check["passed"]]
        told = "; ".join(filter(None, [each["reason"], *failed]))
        yield each["id"], each["name"], each["result"], each["seconds"], told


def section(title: str, head: Iterable[str], rows: Rows) -> str:
    """Format a section of the page: a heading and a table."""
    return f"## {title}\n\n{table(' | '.join(head), rows)}"


def page(folder: Path, here: dict[str, Any], found: list[dict[str, Any]]) -> str:
    """Format the page, with a section for each kind of result."""
    tests, faults = ("run", "tests", "failed", "errors", "skipped"), ("fault", "name")
    parts = [
        f"# Evidence of commit {here['commit']}\n",
        f"On {here['cores']} cores ({here['processor']}), Python {here['python']}.\n",
        section("Tests", tests, test_rows(folder)),
        section("Numbers", ("number", "asked", "worst", "cases", "test"), number_rows(found)),
        section("Faults", (*faults, "result", "seconds", "what failed"), fault_rows(folder)),
    ]
    for each in read(folder, "search-*.json"):
        head, *rows = search_rows(each)
        parts += [section(f"Search: {each['kind']}", head, rows), f"{search_summary(each)}.\n"]
    for each in read(folder, "link.json"):
        parts.append(section("Relay", each["lines"][0], (row.values() for row in each["lines"])))
    if (path := folder / "mutants.txt").exists():
        results = (line.rpartition(": ")[2] for line in path.read_text("utf-8").splitlines())
        parts.append(section("Mutants", ("result", "mutants"), Counter(results).most_common()))
    return "\n".join(parts)


def write(folder: Path) -> None:
    """Write the page and the JSON files to the folder with the results."""
    here, found = environment(), numbers(folder)
    write_json(folder / "environment.json", here)
    write_json(folder / "numbers.json", {"schemaVersion": 1, "numbers": found})
    (folder / "index.md").write_text(page(folder, here, found), encoding="utf-8")


if __name__ == "__main__":
    write(Path(sys.argv[1]))
