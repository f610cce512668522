# SPDX-License-Identifier: Apache-2.0

"""The score of a student's files: for JSON, as a table, for Gradescope; those of a class as CSV."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from io import StringIO
from typing import Any

from cloudrc.base.text import table
from cloudrc.config.task import Task

FIRST, REMARKS = ("hand_in", "score", "max_score", "valid"), "remarks"
"""First columns of a class's table, and the last one."""

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


def columns(tasks: Iterable[Task]) -> list[str]:
    """Return the columns of a class's table: one for each test of the tasks."""
    tests = [
        f"{name}: {test}"
        for task in tasks
        for name, part in task.parts.items()
        for test in part.tests
    ]
    return [*FIRST, *dict.fromkeys(tests), REMARKS]


def csv_line(cells: Iterable[object]) -> str:
    """Return a line of a table in CSV, without its end."""
    out = StringIO()
    csv.writer(out, lineterminator="").writerow(cells)
    return out.getvalue()


def as_row(name: str, result: Mapping[str, Any], heads: Sequence[str]) -> str:
    """Return a hand-in's line of the table with the columns `heads`.

    The column `remarks` says, once for each cause, what tests without points found.
    """
    cells: dict[str, Any] = {"hand_in": name} | {key: result[key] for key in FIRST[1:]}
    causes = dict[str, list[str]]()
    for row in result["checks"]:
        test = f"{row['part']}: {row['test']}"
        cells[test] = row["points"]
        if not row["points"]:
            causes.setdefault(row["seen"], []).append(test)
    cells[REMARKS] = " | ".join(f"{seen} ({', '.join(on)})" for seen, on in causes.items())
    return csv_line(cells.get(head, "") for head in heads)


def read_table(text: str, heads: Sequence[str]) -> list[list[str]]:
    """Return the whole and valid rows of a class's table; raise a ValueError for another table."""
    first, *rows = [*csv.reader(StringIO(text))] or [[*heads]]
    if first != [*heads]:
        raise ValueError("it has other columns; it is the table of another task")
    place = heads.index("valid")
    return [row for row in rows if len(row) == len(heads) and row[place].lower() == "true"]
