# SPDX-License-Identifier: Apache-2.0

"""Judge the flights of `make moonshot`: does a second of round trip matter?

    python -m tools.moonshot build/moonshot     # exit code 1: it does

All flights have to succeed. The median time of a mission may be longer than without a delay by 1 %,
and by 2 % in wind, noise, 30 % of loss and with a wrong mass. It counts from the first command that
the robot applies, to the touch, or to the end as the robot sees it: teleop ends the mission one way
of the link earlier.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from pathlib import Path
from statistics import median
from typing import Any

from cloudrc.base.text import table
from cloudrc.flight.trials.rows import Row, read_rows
from cloudrc.studies.sweep import read_summary

LONGER_MAX = {"moonshot": 0.01, "moonshot-disturbed": 0.02}
"""Folder of a sweep -> by how much a mission may take longer than without a delay."""


def time_of(row: Row) -> float:
    """Return the time of a mission since the first command that the robot applied [s]."""
    numbers = row["numbers"]
    end = numbers.get("contact_time", numbers["duration"] + numbers["downlink_delay_mean"])
    return float(end - numbers["start_delay"])


def judge(folder: Path) -> tuple[str, bool]:
    """Return a table of a sweep's flights, and whether all is as it should be."""
    groups: dict[tuple[Any, ...], list[Row]] = defaultdict(list)
    flown = read_rows(folder)
    for row in flown.values():
        groups[tuple(row["point"].values())].append(row)
    lines = [("robot", "controller", "RTT [ms]", "success", "time [s]", "longer")]
    is_good = len(flown) == read_summary(folder)["flights"]
    before = 0.0
    for (robot, controller, delay_ms), rows in sorted(groups.items()):
        good = [row for row in rows if row["verdict"] == "success"]
        time = median(map(time_of, good)) if good else float("nan")
        before = time if delay_ms == 0 else before
        longer = time / before - 1
        is_good &= len(good) == len(rows) and longer <= LONGER_MAX[folder.name]
        counts = f"{len(good)} of {len(rows)}"
        rtt = f"{2 * delay_ms:g}"
        lines.append((robot, controller, rtt, counts, f"{time:.2f}", f"{longer:+.1%}"))
    return table([*lines, ("flown", f"{len(flown)}", *[""] * 4)], right=(2, 4, 5)), is_good


def main(folder: Path) -> int:
    """Print the tables; return 1 unless every flight is as it should be."""
    found = {name: judge(folder / name) for name in LONGER_MAX}
    for name, (text, _) in found.items():
        print(f"{name}\n\n{text}\n")
    return 0 if all(is_good for _, is_good in found.values()) else 1


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
