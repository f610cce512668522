"""The numbers of link and safety: what tests have measured, printed beside what was asked.

`make figures` prints what the tests have noted of the sources as they are now; the full numbers
need `make nightly`, the slices of CI are noted by `make test` and `make process`.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from collections import defaultdict
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

from cloudrc import __version__
from cloudrc.cli.faults_slices import sources
from cloudrc.cli.output import table
from cloudrc.report.document import environment_document

FOLDER = Path(__file__).resolve().parents[1] / "build" / "figures"
ROUNDING = 1e-9
"""Of a number of nanoseconds that has become seconds."""
NONE = "no numbers of these sources yet: run make test, make process or make nightly"
PAGE = """\
# The numbers of link and safety

Written by `make nightly` (`python tools/figures.py --document docs/safety/numbers.md`); do not
edit. Each row is the worst of N cases: what tests have asked for, and what they have measured.
Times are those of the machine that it ran on. What is composed at random has pages of its own:
[search](search.md), [adversary](adversary.md), [clean](clean.md); the faults one by one:
[faults](faults.md).
"""


@cache
def flown() -> str:
    """Hash what is measured, as it was when this process first asked."""
    return sources(apart=())


def note(
    test: str, name: str, measured: float, relation: str, asked: float, unit: str, count: int
) -> dict[str, Any]:
    """Keep one number; a test that is run again replaces what it had noted before.

    Args:
        test: Its id: file, function and parameters.
        name: Of the number, in words; tests that share it are summed up in one row.
        measured: What came out [any unit].
        relation: "<=", ">=" or "==": how it has to compare with what was asked.
        asked: What was asked [any unit].
        unit: Of both.
        count: How many cases this is the worst of.

    Returns:
        What is kept.
    """
    FOLDER.mkdir(parents=True, exist_ok=True)
    key = hashlib.sha256(f"{test}\n{name}".encode()).hexdigest()[:24]
    document = {
        "test": test,
        "name": name,
        "measured": measured,
        "relation": relation,
        "asked": asked,
        "unit": unit,
        "count": count,
        "sources": flown(),
    }
    new = FOLDER / f"{key}.new"
    new.write_text(json.dumps(document), encoding="utf-8")
    new.replace(FOLDER / f"{key}.json")
    return document


def read() -> list[dict[str, Any]]:
    """Sum up what was noted of these sources: the worst of each number, and of how many cases."""
    groups: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for path in sorted(FOLDER.glob("*.json")):
        found = json.loads(path.read_text(encoding="utf-8"))
        if found.get("sources") == flown():
            groups[found["name"]].append(found)
    rows = []
    for _, group in sorted(groups.items()):
        worst = (min if group[0]["relation"] == ">=" else max)(group, key=lambda g: g["measured"])
        rows.append(worst | {"count": sum(each["count"] for each in group)})
    return rows


def holds(row: dict[str, Any]) -> bool:
    """Whether what was measured is what was asked."""
    measured, asked = row["measured"], row["asked"]
    if row["relation"] == "==":
        return bool(measured == asked)
    return bool(measured <= asked + ROUNDING if row["relation"] == "<=" else measured >= asked)


def cells(rows: list[dict[str, Any]]) -> list[tuple[str, ...]]:
    """Lay the rows out as text, a head first."""
    return [
        ("number", "asked", "measured", "N", "test"),
        *(
            (
                row["name"],
                f"{row['relation']} {row['asked']:g} {row['unit']}".rstrip(),
                f"{row['measured']:.4g} {row['unit']}".rstrip() + "  MISSED" * (not holds(row)),
                f"{row['count']:,}",
                row["test"].partition("::")[0],
            )
            for row in rows
        ),
    ]


def page(rows: list[dict[str, Any]]) -> str:
    """Lay the rows out as a page of the documentation."""
    head, *lines = cells(rows)
    where = environment_document()
    return "\n".join(
        [
            *PAGE.splitlines(),
            f"Measured on {where['cores']} cores ({where['processor']}), Python {where['python']}.",
            "",
            f"| {' | '.join(head)} |",
            "|---|---|---|---|---|",
            *(f"| {' | '.join(line)} |" for line in lines),
            "",
            f"Measured by cloudrc {__version__}; SHA-256 of its sources: `{flown()[:16]}`.",
            "",
        ]
    )


def main(arguments: Sequence[str] = ()) -> int:
    """Print the table; 1 if a number was missed, 3 if there are none."""
    parser = argparse.ArgumentParser(description="Print what tests have measured.")
    parser.add_argument("--document", type=Path, metavar="FILE", help="write it as a page, too")
    options = parser.parse_args(arguments)
    rows = read()
    if not rows:
        print(NONE, file=sys.stderr)
        return 3
    print(table(cells(rows)))
    if options.document:
        options.document.write_text(page(rows), encoding="utf-8")
    return 0 if all(map(holds, rows)) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
