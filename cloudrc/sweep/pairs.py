"""Read finished flights, of a sweep or of two folders of runs, and pair them."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from cloudrc.config.document import read_document
from cloudrc.errors import BadInputError
from cloudrc.metrics import Number
from cloudrc.sweep import store
from cloudrc.sweep.compare import Pair
from cloudrc.sweep.flight import Outcome

IGNORED = ("seed", "name", "description", "report")
"""Keys of an experiment that do not affect the flight, and the seed."""
OF_LINK = (
    *("guard.command_age_max_ms", "guard.speed_max_mps"),
    *("cloud.horizon_max_s", "cloud.freeze_after_s"),
)
"""Keys whose defaults depend on the link profile."""


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


def of_sweep(folder: Path, a: str, b: str) -> tuple[list[Pair], str]:
    """Pair the rows with the values `a` and `b` of one axis that agree in all other axes and seed.

    `a` and `b` are values, or AXIS=VALUE. Also return a text that names the axis.

    Raises:
        BadInputError: If not exactly one axis has both values, or if they are the same.
    """
    rows = read_flights(folder)
    axes = {axis: list(dict.fromkeys(row.point[axis] for row in rows)) for axis in rows[0].point}
    sides = [
        [(axis, v) for axis in axes for v in axes[axis] if text in (f"{v}", f"{axis}={v}")]
        for text in (a, b)
    ]
    found = [(axis, x, y) for axis, x in sides[0] for other, y in sides[1] if axis == other]
    if len(found) != 1 or a == b:
        known = "; ".join(f"{axis}: {', '.join(map(str, values))}" for axis, values in axes.items())
        raise BadInputError(
            f"{folder}: A and B must be two values of one axis, VALUE or AXIS=VALUE; it has {known}"
        )
    axis, first, second = found[0]
    flown: dict[str, dict[Any, Outcome]] = {}
    for row in rows:
        rest = {name: value for name, value in row.point.items() if name != axis}
        shared = json.dumps({**rest, "seed": row.seed})
        flown.setdefault(shared, {})[row.point[axis]] = row.outcome
    return [
        Pair(json.loads(shared), each[first], each[second])
        for shared, each in flown.items()
        if first in each and second in each
    ], f"{axis} in {folder}"


def of_folders(a: Path, b: Path) -> tuple[list[Pair], str]:
    """Pair the runs of two folders by their seeds; also return a text with the keys that differ.

    Raises:
        BadInputError: If no seed is in both, if nothing differs, or if keys of several sections
            differ: then nobody could tell which of them has an effect.
    """
    first, second = _runs(a), _runs(b)
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
    return pairs, f"folders that differ in {', '.join(keys)}"


def _runs(folder: Path) -> dict[int, tuple[Outcome, Mapping[str, Any]]]:
    """Read the runs in a folder, which may be a run: seed -> result, and mode with experiment."""
    found = dict[int, tuple[Outcome, Mapping[str, Any]]]()
    for path in (folder / "report.json", *sorted(folder.glob("seed-*/report.json"))):
        if path.is_file():
            report = json.loads(path.read_bytes())
            numbers = {n: Number(e["value"], e["unit"], "") for n, e in report["numbers"].items()}
            text = "; ".join(failure["text"] for failure in report["failures"])
            config = read_document(path.with_name("config.yaml"), f"{path.parent}/config.yaml").tree
            flown = {"mode": report["mode"], **config}
            found[report["seed"]] = Outcome(report["verdict"], (), numbers, text=text), flown
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
