"""Read finished flights, of a sweep or of two folders of runs, and pair them."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from cloudrc.config.document import read_document
from cloudrc.errors import BadInputError
from cloudrc.sweep import store
from cloudrc.sweep.compare import Pair
from cloudrc.sweep.flight import Row

IGNORED = ("seed", "name", "description", "report")
"""Keys of an experiment that do not affect the flight, and the seed."""
OF_LINK = (
    *("guard.command_age_max_ms", "guard.speed_max_mps"),
    *("cloud.horizon_max_s", "cloud.freeze_after_s"),
)
"""Keys whose defaults depend on the link profile."""


class Found(NamedTuple):
    """Finished flights in pairs."""

    pairs: list[Pair]
    units: dict[str, str]  # metric -> unit
    what: str  # what differs, and where


def read_flights(folder: Path) -> tuple[list[Row], dict[str, str], str]:
    """Read the rows of a sweep in the order of its grid.

    Also return the unit of each metric, and a text that says how many flights are missing, or "".
    A value of a point that is neither a number nor a text becomes text. Raise a BadInputError if
    there are no rows.
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
    """Pair the rows with the values `a` and `b` of one axis that agree in all other axes and seed.

    `a` and `b` are values, or AXIS=VALUE.

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
            f"{folder}: A and B must be two values of one axis, VALUE or AXIS=VALUE; it has {known}"
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


def of_folders(a: Path, b: Path) -> Found:
    """Pair the runs of two folders by their seeds; they may differ in keys of one section.

    Raises:
        BadInputError: If no seed is in both, if nothing differs, or if keys of several sections
            differ: then nobody could tell which of them has an effect.
    """
    units = dict[str, str]()
    first, second = _runs(a, units), _runs(b, units)
    seeds = sorted(first.keys() & second.keys())
    if not seeds:
        raise BadInputError(f"{a} and {b} have no seed in common; fly both with the same --seeds")
    before, after = (dict(_leaves(side[seeds[0]][1])) for side in (first, second))
    keys = sorted(key for key in before | after if before.get(key) != after.get(key))
    if any(key.startswith("link.") for key in keys):
        keys = [key for key in keys if key not in OF_LINK]
    if len({key.partition(".")[0] for key in keys}) != 1:
        problem = f"differ in several sections: {', '.join(keys)}" if keys else "are the same"
        raise BadInputError(f"{a} and {b} {problem}; compare flights that differ in one section")
    pairs = [Pair({"seed": seed}, first[seed][0], second[seed][0]) for seed in seeds]
    return Found(pairs, units, f"folders that differ in {', '.join(keys)}")


def row_of(report: Mapping[str, Any]) -> Row:
    """Make the row of a run from its report.json."""
    failures, numbers = report["failures"], report["numbers"]
    return {
        **{"seed": report["seed"], "verdict": report["verdict"]},
        "failures": [failure["code"] for failure in failures],
        "text": "; ".join(failure["text"] for failure in failures),
        "numbers": {name: number["value"] for name, number in numbers.items()},
    }


def _runs(folder: Path, units: dict[str, str]) -> dict[int, tuple[Row, Mapping[str, Any]]]:
    """Read the runs in a folder, which may be a run: seed -> row, and mode with experiment.

    The units of their metrics are added to `units`.
    """
    found = dict[int, tuple[Row, Mapping[str, Any]]]()
    for path in (folder / "report.json", *sorted(folder.glob("seed-*/report.json"))):
        if path.is_file():
            try:
                report = json.loads(path.read_bytes())
                row = row_of(report)
                units |= {name: number["unit"] for name, number in report["numbers"].items()}
            except (ValueError, TypeError, LookupError, AttributeError) as error:
                text = "is not a report of cloudrc; 'cloudrc report' writes it again"
                raise BadInputError(f"{path}: {text}") from error
            config = read_document(path.with_name("config.yaml"), f"{path.parent}/config.yaml").tree
            found[row["seed"]] = row, {"mode": report.get("mode"), **config}
    if not found:
        raise BadInputError(f"{folder}: has no report.json; name a folder of 'cloudrc run'")
    return found


def _leaves(tree: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[str, Any]]:
    """Yield the keys of a configuration, such as "cloud.predictor.name", with their values."""
    if not isinstance(tree, dict):
        yield ".".join(path), tree
        return
    for key, value in tree.items():
        if path or key not in IGNORED:
            yield from _leaves(value, (*path, key))
