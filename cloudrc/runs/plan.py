"""Keep the plan of a sweep in its folder, so that each shard checks only the points of its flights.

The plan has the keys of all flights. The first shard checks all points and writes the plan, while
the others wait. The plan only saves time: a shard compares it with the keys of its own flights.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict

from cloudrc import files, source
from cloudrc.errors import BadInputError
from cloudrc.runs import store
from cloudrc.runs.grid import Grid, See, UncheckedGrid, check
from cloudrc.runs.lock import lock_plan

PLAN_MAX = 1 << 30
"""Largest length of the file of a plan [bytes]."""


class _Plan(BaseModel):
    """The content of the file."""

    model_config = ConfigDict(strict=True)

    code: str  # hash of cloudrc's code
    sweep: str  # hash of the content of the sweep's file, without its folder
    folder: str  # of the sweep's file
    keys: list[str]  # of all flights, in the order of the grid


def check_shard(
    grid: UncheckedGrid,
    folder: Path,
    shard: int,
    count: int,
    see: See = lambda done, points, work: None,
    wait: Callable[[str], None] = lambda work: None,
) -> Grid:
    """Check the points of shard number `shard` of `count`; without a plan, check all points.

    While another shard checks all points, call `wait` again and again; its argument says how much
    work that is.

    Raises:
        BadInputError: If a point has problems, if the folder belongs to another sweep or to other
            code, or if a file has changed since the plan.
    """
    plan = _read(folder, grid)
    if plan is None:
        with lock_plan(folder, lambda: wait(grid.size)):
            plan = _read(folder, grid)  # another shard may have written it
            if plan is None:
                return _check_all(grid, folder, see)
    return _check_part(grid, folder, plan, shard, count, see)


def _check_all(grid: UncheckedGrid, folder: Path, see: See) -> Grid:
    """Check all points of a sweep, begin it in its folder, and write the plan."""
    store.refuse_other_code(folder, (), is_shared=True)  # now, not after minutes of checks
    checked = check(grid, grid.points(), see)
    store.begin(folder, checked, is_shared=True)  # a sweep that is refused leaves no plan
    plan = _Plan(
        code=source.code_hash(),
        sweep=_hash(grid.file),
        folder=grid.file["folder"],
        keys=[*checked.point_of],
    )
    files.write_atomically(folder / store.PLAN, plan.model_dump_json().encode())
    return checked


def _check_part(
    grid: UncheckedGrid, folder: Path, plan: _Plan, shard: int, count: int, see: See
) -> Grid:
    """Check the points of a shard's flights, and compare their keys with those of the plan."""
    points, seeds, keys = grid.points(), len(grid.seeds), plan.keys
    # A point's first flight of this shard follows (shard - 1 - number * seeds) % count others.
    own = [n for n in range(len(points)) if (shard - 1 - n * seeds) % count < seeds]
    part = check(grid, [points[number] for number in own], see)
    planned = (key for n in own for key in keys[n * seeds : (n + 1) * seeds])
    if [*part.flights] != [*planned]:
        text = f"a file or package of the sweep has changed since {store.PLAN} was written"
        text = store.describe_changes(folder, part.files) or text
        raise BadInputError(f"--out {folder}: {text}; name a new folder")
    summary = store.read_summary(folder)
    return replace(
        part,
        file=grid.file | {"folder": plan.folder},
        name=summary["experiment"],
        units=summary["units"],
        files=summary["files"],
        point_of={key: points[number // seeds][0] for number, key in enumerate(keys)},
    )


def _read(folder: Path, grid: UncheckedGrid) -> _Plan | None:
    """Return the plan in the folder of a sweep; None if there is none of this sweep and code."""
    with suppress(OSError, ValueError):
        plan = _Plan.model_validate_json(files.read(folder / store.PLAN, PLAN_MAX))
        is_same = plan.code == source.code_hash() and plan.sweep == _hash(grid.file)
        if is_same and len({*plan.keys}) == len(plan.keys) == grid.flights:
            return plan
    return None


def _hash(file: Mapping[str, Any]) -> str:
    """Return the hash of the content of a sweep's file; the order of its axes counts.

    Its folder does not: shards of several machines may have it in different places.
    """
    content = {key: value for key, value in file.items() if key != "folder"}
    return sha256(json.dumps(content, default=str).encode()).hexdigest()
