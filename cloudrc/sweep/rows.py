"""Read the rows of a sweep."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

from cloudrc.errors import BadInputError
from cloudrc.metrics import Number
from cloudrc.sweep.flight import Outcome


class Row(NamedTuple):
    """A flight of a sweep."""

    point: dict[str, Any]  # axis -> value
    seed: int
    outcome: Outcome


def read_rows(folder: Path) -> list[Row]:
    """Read the rows of all shards; raise a BadInputError if there are none."""
    try:
        units = json.loads((folder / "sweep.json").read_bytes())["units"]
    except (OSError, ValueError, KeyError) as error:
        raise BadInputError(f"{folder}: no finished sweep; name one, or run it again") from error
    rows = []
    for path in sorted(folder.glob("rows*.jsonl")):
        for line in path.read_text().splitlines():
            row = json.loads(line)
            numbers = {n: Number(v, units[n], "") for n, v in row["numbers"].items()}
            outcome = Outcome(row["verdict"], tuple(row["failures"]), numbers)
            rows.append(Row(row["point"], row["seed"], outcome))
    return rows
