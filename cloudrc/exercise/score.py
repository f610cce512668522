"""The score of a student's files: for JSON, as a table, for Gradescope; those of a class as CSV."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from io import StringIO
from typing import Any

from cloudrc.text import table

NOT_VALID = (
    "not valid: a part took too long; check again with less load, or look for a file that waits"
)
"""Mark of a score."""


def sum_up(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the score of the tests that `scoring.check` yields, as values for JSON."""
    score, of = (round(sum(row[key] for row in rows), 1) for key in ("points", "max_points"))
    valid = all(row["valid"] for row in rows)
    return {"score": score, "max_score": of, "valid": valid, "checks": [*rows]}


def as_text(result: Mapping[str, Any]) -> str:
    """Format a score, the result of `sum_up`, for people."""
    cells = [("part", "test", "points", "seen")]
    for row in result["checks"]:
        points = f"{row['points']:g}/{row['max_points']}"
        cells.append((row["part"], row["test"], points, row["seen"]))
    text = f"{table(cells, right=(2,))}\n\nscore {result['score']:g} of {result['max_score']}"
    return text if result["valid"] else f"{text}\n{NOT_VALID}"


def for_gradescope(result: Mapping[str, Any]) -> dict[str, Any]:
    """Return a score, the result of `sum_up`, as Gradescope reads it in results.json."""
    names = {"points": "score", "max_points": "max_score", "seen": "output"}
    tests = [
        {"name": f"{row['part']}: {row['test']}", "visibility": "visible"}
        | {name: row[key] for key, name in names.items()}
        for row in result["checks"]
    ]
    found = {"score": result["score"], "visibility": "visible", "tests": tests}
    return found if result["valid"] else {**found, "output": NOT_VALID}


def as_csv(scores: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the scores of several hand-ins by their names: a line each, a column for each test.

    The column `remarks` says what tests without points found.
    """
    out = StringIO()
    names = {f"{row['part']}: {row['test']}": 0 for s in scores.values() for row in s["checks"]}
    first = ("hand_in", "score", "max_score", "valid")
    writer = csv.DictWriter(out, [*first, *names, "remarks"], lineterminator="\n")
    writer.writeheader()
    for hand_in, result in scores.items():
        rows = {f"{row['part']}: {row['test']}": row for row in result["checks"]}
        remarks = {f"{name}: {row['seen']}" for name, row in rows.items() if not row["points"]}
        writer.writerow(
            {name: row["points"] for name, row in rows.items()}
            | {"hand_in": hand_in, "remarks": " | ".join(sorted(remarks))}
            | {name: result[name] for name in first[1:]}
        )
    return out.getvalue().rstrip("\n")
