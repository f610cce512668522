"""The score of a student's files: as values for JSON, as a table and for Gradescope."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
