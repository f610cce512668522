"""Find pairs of finished flights: in the rows of a sweep, or in two folders of runs."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from cloudrc.config.document import parse_value, read_document
from cloudrc.errors import BadInputError
from cloudrc.metrics import Number
from cloudrc.sweep.compare import Pair
from cloudrc.sweep.flight import Outcome
from cloudrc.sweep.rows import read_rows

IGNORED = ("seed", "name", "description", "report")
"""Keys of an experiment that do not matter for a comparison."""
OF_LINK = (
    *("guard.command_age_max_ms", "guard.speed_max_mps"),
    *("cloud.horizon_max_s", "cloud.freeze_after_s"),
)
"""Keys whose defaults depend on the link profile."""


def of_sweep(folder: Path, a: str, b: str) -> tuple[list[Pair], str]:
    """Pair the rows of a sweep in which one axis is `a` and `b`; return pairs and axis.

    `a` and `b` are values, or AXIS=VALUE where several axes have such values.

    Raises:
        BadInputError: If the folder is no sweep, or if not exactly one axis has both values.
    """
    rows = read_rows(folder)
    axes: dict[str, list[Any]] = {}
    for row in rows:
        for axis, value in row.point.items():
            if value not in axes.setdefault(axis, []):
                axes[axis].append(value)
    found = [
        (axis, first, second)
        for axis, values in axes.items()
        for first in values if _is_meant(a, axis, first)
        for second in values if _is_meant(b, axis, second)
    ]  # fmt: skip
    if len(found) != 1:
        known = "; ".join(f"{axis}: {', '.join(map(str, axes[axis]))}" for axis in axes)
        problem = "several axes have" if found else "no axis has"
        raise BadInputError(
            f"{folder}: {problem} the values {a!r} and {b!r}; write AXIS=VALUE, there are {known}"
        )
    axis, first, second = found[0]
    if first == second:
        raise BadInputError(f"A and B are both {a!r}; name two values of {axis}")
    sides: tuple[dict[str, Any], ...] = ({}, {})
    for row in rows:
        rest = {**row.point, "seed": row.seed}
        value = rest.pop(axis)
        if value in (first, second):
            sides[value == second][json.dumps(rest)] = row.outcome
    return [Pair(json.loads(rest), flown, sides[1][rest])
            for rest, flown in sides[0].items() if rest in sides[1]], axis  # fmt: skip


def _is_meant(text: str, axis: str, value: Any) -> bool:
    text = text.removeprefix(f"{axis}=")
    return text == str(value) or bool(parse_value(text, "value") == value)


def of_folders(a: Path, b: Path) -> tuple[list[Pair], list[str]]:
    """Pair the runs of two folders by their seeds; return pairs and the keys that differ.

    Raises:
        BadInputError: If no seed is in both, if nothing differs, or if keys of several sections
            differ: then nobody could tell which of them has an effect.
    """
    runs = [_runs(folder) for folder in (a, b)]
    seeds = sorted(runs[0].keys() & runs[1].keys())
    if not seeds:
        raise BadInputError(f"{a} and {b} have no seed in common; fly both with the same --seeds")
    pairs = [Pair({"seed": n}, *(_outcome(side[n][1]) for side in runs)) for n in seeds]
    flown = [
        {"mode": side[seeds[0]][1]["mode"]}
        | dict(_leaves(read_document(path := side[seeds[0]][0] / "config.yaml", str(path)).tree))
        for side in runs
    ]
    first, second = flown
    keys = sorted(key for key in first | second if first.get(key) != second.get(key))
    if any(key.startswith("link.") for key in keys):
        keys = [key for key in keys if key not in OF_LINK]
    if not keys:
        raise BadInputError(f"{a} and {b} are flights of the same experiment; change one of them")
    if len({key.partition(".")[0] for key in keys}) > 1:
        raise BadInputError(f"{a} and {b} differ in more than one section: {', '.join(keys)}; "
                            "fly one of them again, with one change")  # fmt: skip
    return pairs, keys


def _runs(folder: Path) -> dict[int, tuple[Path, Mapping[str, Any]]]:
    """Return the runs in a folder, which may be a run itself: seed -> folder and report."""
    found = {}
    for path in (folder / "report.json", *sorted(folder.glob("seed-*/report.json"))):
        if path.is_file():
            report = json.loads(path.read_bytes())
            found[report["seed"]] = (path.parent, report)
    if not found:
        raise BadInputError(f"{folder}: has no report.json; name a folder of 'cloudrc run'")
    return found


def _outcome(report: Mapping[str, Any]) -> Outcome:
    numbers = {n: Number(e["value"], e["unit"], "") for n, e in report["numbers"].items()}
    return Outcome(report["verdict"], numbers=numbers,
                   text="; ".join(f["text"] for f in report["failures"][:1]))  # fmt: skip


def _leaves(tree: Any, above: Sequence[str] = ()) -> Iterator[tuple[str, Any]]:
    """Yield the values of a configuration with their keys, such as "cloud.predictor.name"."""
    if isinstance(tree, dict):
        for key, value in tree.items():
            if above or key not in IGNORED:
                yield from _leaves(value, (*above, key))
    else:
        yield ".".join(above), tree
