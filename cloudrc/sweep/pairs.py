"""Read the finished flights of a sweep, and pair them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from cloudrc.errors import BadInputError
from cloudrc.sweep import store
from cloudrc.sweep.compare import Pair
from cloudrc.sweep.flight import Row


class Found(NamedTuple):
    """Finished flights in pairs."""

    pairs: list[Pair]
    units: dict[str, str]  # metric -> unit
    what: str  # in words: the compared axis, the folder, and limits of the comparison


def read_flights(folder: Path) -> tuple[list[Row], dict[str, str], str]:
    """Read the rows of a sweep in the order of its grid.

    Also return metric -> unit, and how many flights are missing, in words ("" if none). Values of
    axes that are neither numbers nor text become JSON text. Raise a BadInputError if there are no
    rows.
    """
    summary = store.read_summary(folder)
    axes = summary["axes"]

    def place(row: Row) -> list[int]:
        return [*(axes[axis].index(value) for axis, value in row["point"].items()), row["seed"]]

    rows = sorted(store.read_rows(folder).values(), key=place)
    for row in rows:
        row["point"] = {axis: value if type(value) in (str, int, float) else json.dumps(value)
                        for axis, value in row["point"].items()}  # fmt: skip
    if not rows:
        raise BadInputError(f"{folder}: has no rows; run the sweep again with this --out")
    missing = summary["flights"] - len(rows)
    return rows, summary["units"], f"{missing} flights are not done" if missing else ""


def values_of(rows: Sequence[Row]) -> dict[str, list[Any]]:
    """Return the values of each axis in the order of the grid."""
    return {axis: list(dict.fromkeys(row["point"][axis] for row in rows))
            for axis in rows[0]["point"]}  # fmt: skip


def of_sweep(folder: Path, a: str, b: str) -> Found:
    """Pair each row with the value `a` of an axis with the row that differs only in the value `b`.

    `a` and `b` are texts: VALUE or AXIS=VALUE.

    Raises:
        BadInputError: If not exactly one axis has both values, or if they are the same.
    """
    rows, units, missing = read_flights(folder)
    axes = values_of(rows)
    sides = [
        [(axis, v) for axis in axes for v in axes[axis] if text in (f"{v}", f"{axis}={v}")]
        for text in (a, b)
    ]
    found = [(axis, x, y) for axis, x in sides[0] for other, y in sides[1] if axis == other]
    if len(found) != 1 or found[0][1] == found[0][2]:
        known = "; ".join(f"{axis}: {', '.join(map(str, values))}" for axis, values in axes.items())
        raise BadInputError(
            f"{folder}: A and B must be two values of one axis, VALUE or AXIS=VALUE; axes: {known}"
        )
    axis, first, second = found[0]
    flown: dict[str, dict[Any, Row]] = {}
    for row in rows:
        rest = {name: value for name, value in row["point"].items() if name != axis}
        shared = json.dumps({**rest, "seed": row["seed"]})
        flown.setdefault(shared, {})[row["point"][axis]] = row
    pairs = [
        Pair(json.loads(shared), each[first], each[second])
        for shared, each in flown.items()
        if first in each and second in each
    ]
    what = f"{axis} in {folder}" + (f", of which {missing}" if missing else "")
    if pooled := ", ".join(name for name, each in axes.items() if name != axis and len(each) > 1):
        what += f", over all values of {pooled}; flights with equal seeds depend on each other, "
        what += "so p is too small"
    return Found(pairs, units, what)
