# SPDX-License-Identifier: Apache-2.0

"""Record flights in MCAP files, and read the files as arrays.

Only the modules `ros`, `writer` and `reader` need the packages of `cloudrc[record]`.
"""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path

WALL_OFFSET = "wall_clock_offset_ns"
"""Metadata key, only in real time: wall time minus the stamps' clock at the opening of the file
[ns]."""
STOPPED = "stopped"
"""Metadata key: the failure code of what stopped the recorder, such as disk_full."""


def part_before(path: Path) -> Path:
    """Return the file of what was recorded before the recording `path` was begun."""
    return path.with_name(f"{path.stem}.before{path.suffix}")


def wall_time(metadata: Mapping[str, str], stamp_ns: int) -> datetime | None:
    """Convert a stamp [ns] to wall time in UTC; None if the recording does not know the wall time.

    The result ignores the lag of world's clock (`slip_ns`) and later steps of the wall clock.
    """
    if WALL_OFFSET not in metadata:
        return None
    micros = (int(metadata[WALL_OFFSET]) + stamp_ns) // 1000
    return datetime.fromtimestamp(0, UTC) + timedelta(microseconds=micros)
