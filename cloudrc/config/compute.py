# SPDX-License-Identifier: Apache-2.0

"""The time that cloud computes: files for `cloud.compute_ms`, and cores that robots share."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path

from cloudrc.base.errors import BadInputError
from cloudrc.base.outside.reuse import reuse
from cloudrc.base.outside.tables import MILLISECONDS, CsvTable
from cloudrc.base.outside.values import Quantity
from cloudrc.base.text import list_some
from cloudrc.config.cloud import Cloud
from cloudrc.config.problems import problem_at

_TIME = Quantity("ms", 0, 100_000)


def compute_times(given: float | str) -> tuple[float, ...]:
    """Return the computing times of `cloud.compute_ms` [ms]: one, or all rows of a file.

    Raise a BadInputError if the file is invalid.
    """
    if isinstance(given, float):
        return (given,)
    words = Path(given), f"compute_ms {given}", MILLISECONDS, _TIME
    return reuse(("compute", given), lambda: read_times(*words))


def check_unshared(cloud: Cloud) -> None:
    """Check, for robots that fly in real time, that their clouds share no emulated cores."""
    if cloud.cores and cloud.compute_ms:
        text = "robots share them in virtual time only; use --mode virtual, or cloud.cores=null"
        raise problem_at("cloud.cores", text)


def read_times(
    path: Path, place: str, units: Mapping[str, float], longest: Quantity
) -> tuple[float, ...]:
    """Read a file with a computing time in each row; the head of its column gives the unit.

    `units` are unit -> size in the unit of `longest`, the valid times. The log names the columns
    that are left out. Raise a BadInputError if the file is invalid, which `place` names.
    """
    table = CsvTable.read(path, place, "compute_ms")
    column = table.only("compute", units, longest)
    if others := table.others(column):
        text = "%s: the column %s counts; left out: %s"
        logging.getLogger("cloudrc").warning(text, place, column.name, list_some(others, 8))
    found = tuple(row.number(column) * column.scale for row in table.rows)
    if not any(found):
        raise BadInputError(f"{place}: has no time above 0; give a time in each line")
    return found
