"""The numbers of link and safety: what tests have measured, printed beside what was asked.

`make figures` prints what the tests have noted since `make clean`; the full numbers need
`make nightly`, the slices of CI are noted by `make test` and `make process`.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

from cloudrc.cli.output import table

FOLDER = Path(__file__).resolve().parents[1] / "build" / "figures"
ROUNDING = 1e-9
"""Of a number of nanoseconds that has become seconds."""


def note(
    test: str, name: str, measured: float, relation: str, asked: float, unit: str, count: int
) -> None:
    """Keep one number; a test that is run again replaces what it had noted before.

    Args:
        test: Its id: file, function and parameters.
        name: Of the number, in words; tests that share it are summed up in one row.
        measured: What came out [any unit].
        relation: "<=", ">=" or "==": how it has to compare with what was asked.
        asked: What was asked [any unit].
        unit: Of both.
        count: How many cases this is the worst of.
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
    }
    new = FOLDER / f"{key}.new"
    new.write_text(json.dumps(document), encoding="utf-8")
    new.replace(FOLDER / f"{key}.json")


def read() -> list[dict[str, Any]]:
    """Sum up what was noted: the worst of each number, and of how many cases."""
    groups: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for path in sorted(FOLDER.glob("*.json")):
        found = json.loads(path.read_text(encoding="utf-8"))
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


def main() -> int:
    """Print the table; 1 if a number was missed, 3 if there are none."""
    rows = read()
    if not rows:
        print("no numbers yet: run make test, make process or make nightly", file=sys.stderr)
        return 3
    cells = [("number", "asked", "measured", "N", "test")]
    for row in rows:
        unit = f" {row['unit']}" if row["unit"] else ""
        missed = "" if holds(row) else "  MISSED"
        cells.append(
            (
                row["name"],
                f"{row['relation']} {row['asked']:g}{unit}",
                f"{row['measured']:.4g}{unit}{missed}",
                f"{row['count']:,}",
                row["test"].partition("::")[0],
            )
        )
    print(table(cells))
    return 0 if all(map(holds, rows)) else 1


if __name__ == "__main__":
    sys.exit(main())
