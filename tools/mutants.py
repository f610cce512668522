"""The mutants that no test notices, against the page that gives each its reason.

`make mutants` ends with it. Reads what `mutmut results --all true` prints.
"""

from __future__ import annotations

import re
import sys
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

PAGE = Path(__file__).resolve().parents[1] / "docs" / "safety" / "mutants.md"
PACKAGES = {
    "Guard": "cloudrc.world.",
    "Journal": "cloudrc.cloud.teleop.",
    "Tunnel": "cloudrc.tunnel.",
}
"""Sections of the page, and what each is about."""
NOTICED = ("killed", "timeout", "caught by type check")
"""A mutant that never ends is ended: that is noticed, too."""

_RESULT = re.compile(r"\s*(?P<name>\S+\.x\S+__mutmut_\d+): (?P<status>.+)")
_ROW = re.compile(r"\| `(?P<where>[\w.]+)` \| .*?(?: \((?P<count>\d+)\))? \| .+ \|")

Counts = Counter[tuple[str, str]]
"""How many mutants, by the section of the page and the function."""


def where(name: str) -> tuple[str, str]:
    """Say what a mutant of mutmut's naming changes: a section of the page, and the function.

    Raises:
        ValueError: If it is of no module that the page is about.
    """
    module, _, mangled = name.rpartition(".x")
    for section, package in PACKAGES.items():
        if module.startswith(package):
            function = mangled.rpartition("__mutmut_")[0].removeprefix("_")
            return section, function.strip("ǁ").replace("ǁ", ".")
    raise ValueError(f"{name}: docs/safety/mutants.md has no section for it")


def listed(page: str) -> Counts:
    """Count the mutants that the page has a reason for."""
    counts: Counts = Counter()
    section = ""
    for line in page.splitlines():
        if line.startswith("## "):
            section = line.removeprefix("## ")
        elif row := _ROW.fullmatch(line):
            counts[section, row["where"]] += int(row["count"] or 1)
    return counts


def compare(results: Iterable[str], page: str) -> tuple[list[str], Counter[str]]:
    """Look for functions of which another number of mutants survives than the page lists.

    Functions with mutants that were not tried are not judged.

    Args:
        results: Lines of mutmut, `name: status`.
        page: The text of docs/safety/mutants.md.

    Returns:
        What differs, one line each, and how many mutants there are of each status.
    """
    statuses: Counter[str] = Counter()
    alive: dict[tuple[str, str], list[str]] = {}
    untried = set()
    for line in results:
        if result := _RESULT.fullmatch(line.rstrip("\n")):
            status, place = result["status"], where(result["name"])
            statuses[status] += 1
            alive.setdefault(place, [])
            if status == "not checked":
                untried.add(place)
            elif status not in NOTICED:
                alive[place].append(result["name"])
    reasons = listed(page)
    gone = [place for place in reasons if place not in alive]
    differ = [
        f"{function} ({section}): the page lists it, it has no mutant" for section, function in gone
    ]
    for place, names in sorted(alive.items()):
        if place not in untried and len(names) != reasons[place]:
            differ.append(
                f"{place[1]} ({place[0]}): {len(names)} survive, the page lists {reasons[place]}"
                + "".join(f"\n  mutmut show {name}" for name in names)
            )
    return differ, statuses


def main() -> int:
    """Print what differs; 1 if anything does, 3 if there are no results."""
    differ, statuses = compare(sys.stdin, PAGE.read_text(encoding="utf-8"))
    if not statuses:
        print("no mutants: run make mutants", file=sys.stderr)
        return 3
    print(", ".join(f"{count} {status}" for status, count in statuses.most_common()))
    print("\n".join(differ or ["docs/safety/mutants.md has a reason for each of them"]))
    return 1 if differ else 0


if __name__ == "__main__":
    sys.exit(main())
