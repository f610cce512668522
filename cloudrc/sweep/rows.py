"""Read the flights of a sweep, to compare or to draw them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

from cloudrc.errors import BadInputError
from cloudrc.metrics import Number
from cloudrc.sweep import store
from cloudrc.sweep.flight import Outcome


class Row(NamedTuple):
    """A flight of a sweep."""

    point: dict[str, Any]  # axis -> value, name, or a list as text
    seed: int
    outcome: Outcome


def read_flights(folder: Path) -> list[Row]:
    """Read the rows of a sweep in the order of its grid; raise a BadInputError if it has none."""
    summary, found = store.read_summary(folder), list[Row]()
    axes, units = summary["axes"], summary["units"]

    def place(row: store.Row) -> list[int]:
        """Return the place in the grid: the rows are in the order in which flights ended."""
        return [*(axes[axis].index(value) for axis, value in row["point"].items()), row["seed"]]

    for row in sorted(store.read_rows(folder).values(), key=place):
        point = {axis: value if type(value) in (str, int, float) else json.dumps(value)
                 for axis, value in row["point"].items()}  # fmt: skip
        numbers = {name: Number(value, units[name], "") for name, value in row["numbers"].items()}
        text = row.get("text", "")
        found.append(Row(point, row["seed"], Outcome(row["verdict"], (), numbers, text=text)))
    if not found:
        raise BadInputError(f"{folder}: has no rows; run the sweep again with this --out")
    return found
