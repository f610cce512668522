# SPDX-License-Identifier: Apache-2.0

"""Read and write the setpoints of a mission: a CSV file with the columns time_s,x_m,y_m,z_m."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np

from cloudrc.base.errors import BadInputError
from cloudrc.base.outside.tables import METRES, SECONDS, CsvTable
from cloudrc.physics.geometry.fence import Fence
from cloudrc.wire.messages import Vector

COLUMNS = ["time_s", "x_m", "y_m", "z_m"]
DRIVE_FILE = "drive.csv"
"""Name of the setpoint file in the folder of a run that the operator drove by hand."""
ROUNDING = 1e-6
"""Largest distance outside the guard's box that counts as a rounding error [m]."""
TimedPosition: TypeAlias = tuple[float, Vector]
"""Time since the first row [s], and position of the setpoint [m], world frame."""


def read_setpoints(path: Path, fence: Fence) -> tuple[TimedPosition, ...]:
    """Read the setpoints of a mission; the time of the first row becomes 0.

    Raise a BadInputError if the file is not usable, or if it leads out of the box in which the
    guard lets the robot fly inside `fence`. A robot that stays on the ground needs no column z_m.
    """
    example = ",".join(COLUMNS if fence.ground is None else COLUMNS[:3])
    table = CsvTable.read(path, f"setpoints {path}", example)
    clock = table.column(("time",), SECONDS)
    columns = [table.column((axis,), METRES) for axis in "xy"]
    if height := (table.column if "z_m" in example else table.find)(("z",), METRES):
        columns.append(height)
    table.refuse_others(clock, *columns)
    found = list[TimedPosition]()
    for row in table.rows:
        time, place = row.number(clock) * clock.scale, map(row.number, columns)
        x, y, z = (*place, fence.inner_low[2])[:3]
        if found and time <= found[-1][0]:
            raise BadInputError(f"{row.where}: time {time:g} s does not rise")
        for column, low, at, high in zip(
            COLUMNS[1:], fence.inner_low, (x, y, z), fence.inner_high, strict=True
        ):
            if not low - ROUNDING <= at <= high + ROUNDING:
                reason = f"{column} is {at:g}; the guard moves the robot from {low:g} to {high:g}"
                raise BadInputError(f"{row.where}: {reason}")
        found.append((time, (x, y, z)))
    if len(found) < 2:
        raise BadInputError(f"{table.place}: has {len(found)} rows; give at least two")
    return tuple((time - found[0][0], position) for time, position in found)


def write_setpoints(setpoints: Iterable[tuple[float, Sequence[float]]], fence: Fence) -> str:
    """Format times [s] and positions [m] as a CSV text that `read_setpoints` can read.

    A position outside the box in which the guard lets the robot fly inside `fence` becomes the
    nearest one inside. Of several setpoints within one microsecond the last one is written.
    """
    low, high = fence.inner_low, fence.inner_high
    inside = {f"{time:.6f}": np.clip(at, low, high) for time, at in setpoints}
    lines = (f"{time},{x:.6g},{y:.6g},{z:.6g}" for time, (x, y, z) in inside.items())
    return "\n".join([",".join(COLUMNS), *lines, ""])
