"""`make bench-link`: compare the relay with what its model draws, and with programs in C.

Close other programs first: the tails of every row are the machine's, too, which is why the anchors
run in turns with the relay. Exit codes: 0 all held, 1 something did not, 3 no C compiler.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from cloudrc.cli.output import table
from cloudrc.config.shipped import names
from cloudrc.errors import CloudrcError
from cloudrc.link.profile import DirectionProfile
from tools.bench_link.flow import Array, judge, run_flow
from tools.bench_link.relays import (
    DELAY,
    LINK,
    compile_anchors,
    fifo_allowed,
    measure_profiles,
    of_c,
    ours,
    wake_lateness,
)

OURS, OF_C, WAKE = "cloudrc relay", "C relay", "C clock_nanosleep"


class Line(NamedTuple):
    """One thing that was asked: in words, the bound, the result, anchors, whether it is held."""

    what: str
    asked: str
    measured: str
    anchor: str
    held: bool


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="make bench-link", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a tenth of the time; for a look")
    parser.add_argument("-o", "--output", choices=("table", "json"), default="table")
    options = parser.parse_args()
    rounds, duration, minute = (2, 3.0, 6.0) if options.quick else (5, 20.0, 60.0)
    try:
        with TemporaryDirectory(prefix="bench-link-") as name:
            programs = compile_anchors(Path(name))
            lines = releases(Path(name), programs, rounds, duration)
            found, details = profiles(Path(name), minute)
            lines += found
    except CloudrcError as error:
        print(f"bench-link: {error}", file=sys.stderr)
        return error.exit_code
    if options.output == "json":
        print(json.dumps({"lines": [line._asdict() for line in lines], "profiles": details}))
    else:
        system = f"Linux {platform.release()}, {os.cpu_count()} CPUs, load {os.getloadavg()[0]:.1f}"
        rows = [(*line[:4], "" if line.held else "MISSED") for line in lines]
        print(table([(system, "asked", "measured", "anchor", ""), *rows]))
        print("\nmeasured minus drawn delay, both ways at 100 Hz; all links at the same time")
        print(table([tuple(details[0]), *(tuple(map(str, row.values())) for row in details)]))
    return 0 if all(line.held for line in lines) else 1


def releases(folder: Path, programs: tuple[Path, Path], rounds: int, duration: float) -> list[Line]:
    """Measure the release errors of our relay and of one in C at 1 kHz, in turns."""
    fifo = fifo_allowed()
    errors: dict[str, list[Array]] = {WAKE: [], OURS: [], OF_C: []}
    for _ in range(rounds):
        errors[WAKE].append(wake_lateness(programs[0], round(1000 * duration), fifo=fifo))
        for name in (OURS, OF_C):
            process = of_c(programs[1]) if name == OF_C else ours(folder, LINK, fifo=fifo)
            if name == OF_C and fifo:
                process.use_fifo()
            (flow,) = run_flow(process.ways[:1], 1000.0, duration, 2 * DELAY)
            process.stop()
            judged = judge(flow, DirectionProfile(DELAY), min(flow.sent.values()))
            errors[name].append(judged.errors)
    # Quantiles of each round, and their median over the rounds [us].
    p50, p99 = (
        {name: 1e6 * float(np.median([np.quantile(one, q) for one in rounds]))
         for name, rounds in errors.items()}
        for q in (0.5, 0.99)
    )  # fmt: skip
    anchor, how = (WAKE, "SCHED_FIFO") if fifo else (OF_C, "normal priority")
    early, ratio = sum(int((one < 0).sum()) for one in errors[OURS]), p99[OURS] / p99[anchor]
    return [
        Line(f"release error p50, 1 kHz, {how}", "<= 60 us", f"{p50[OURS]:.1f} us",
             f"{OF_C} {p50[OF_C]:.0f} us", p50[OURS] <= 60),
        Line(f"release error p99 / {anchor} p99", "<= 1.5", f"{ratio:.2f} ({p99[OURS]:.0f} us)",
             f"{WAKE} {p99[WAKE]:.0f} us, {OF_C} {p99[OF_C]:.0f} us", ratio <= 1.5),
        Line("released early", "0", f"{early} of {sum(map(len, errors[OURS]))}", "", early == 0),
    ]  # fmt: skip


def profiles(folder: Path, seconds: float) -> tuple[list[Line], list[dict[str, object]]]:
    """Judge the shipped profiles; also describe each direction."""
    links: dict[str, dict[str, object]] = {name: {"profile": name} for name in names("profile")}
    rows = measure_profiles(folder, links, seconds, fifo=fifo_allowed())
    errors = [row.judged.errors * 1e3 for row in rows]
    mean, spread = max(abs(one.mean()) for one in errors), max(one.std() for one in errors)
    wrong = [one.wrongly_lost + one.wrongly_arrived for one in (row.judged for row in rows)]
    swapped = sum(row.judged.swapped for row in rows)
    every = np.concatenate(errors)
    early = int((every < 0).sum())
    details: list[dict[str, object]] = [
        {
            "profile": row.name,
            "direction": row.direction,
            "arrived": one.size,
            "mean [ms]": f"{one.mean():.3f}",
            "deviation [ms]": f"{one.std():.3f}",
            "p99 [ms]": f"{np.quantile(one, 0.99):.3f}",
            "largest [ms]": f"{one.max():.3f}",
        }
        for row, one in zip(rows, errors, strict=True)
    ]
    return [
        Line("measured minus drawn, mean, worst profile", "<= 0.3 ms", f"{mean:.3f} ms", "",
             mean <= 0.3),
        Line("measured minus drawn, deviation, worst", "<= 0.5 ms", f"{spread:.3f} ms", "",
             spread <= 0.5),
        Line("lost or arrived, not as drawn", "0", f"{sum(wrong)} of {every.size}", "",
             not any(wrong)),
        Line("out of the order drawn (by > 5 us)", "0", f"{swapped}", "", swapped == 0),
        Line("released early, profiles", "0", f"{early} of {every.size}", "", early == 0),
    ], details  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
