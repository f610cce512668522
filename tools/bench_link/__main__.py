"""`make bench-link`: compare the relay with what its model draws, and with a program in C.

Close other programs first, because they delay the relay. The program in C runs in turns with the
relay and shows how late the machine wakes. Exit codes: 0 all bounds hold, 1 a bound does not, 3 no
C compiler.
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
    RelayProcess,
    compile_program,
    fifo_allowed,
    measure_profiles,
    wake_lateness,
)

DELAY = 0.020
"""Delay of the link whose release errors are measured [s]."""


class Line(NamedTuple):
    """One row of the result: a quantity, its bound, its value, and whether the bound holds."""

    what: str
    asked: str
    measured: str
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
            lines = releases(Path(name), compile_program(Path(name)), rounds, duration)
            lines += profiles(Path(name), minute)
    except CloudrcError as error:
        print(f"bench-link: {error}", file=sys.stderr)
        return error.exit_code
    if options.output == "json":
        print(json.dumps({"lines": [line._asdict() for line in lines]}))
    else:
        system = f"Linux {platform.release()}, {os.cpu_count()} CPUs, load {os.getloadavg()[0]:.1f}"
        rows = [(*line[:3], "" if line.held else "MISSED") for line in lines]
        print(table([(system, "asked", "measured", ""), *rows]))
    return 0 if all(line.held for line in lines) else 1


def releases(folder: Path, program: Path, rounds: int, duration: float) -> list[Line]:
    """Measure how late the relay releases datagrams at 1 kHz, and in turns how late C wakes.

    Both programs use SCHED_FIFO if this user has the right to.
    """
    fifo, link = fifo_allowed(), {"profile": "ideal", "uplink": {"delay_ms": DELAY * 1e3}}
    wakes, errors = list[Array](), list[Array]()
    for _ in range(rounds):
        wakes.append(wake_lateness(program, round(1000 * duration), fifo=fifo))
        relay = RelayProcess(folder, link, fifo=fifo)
        (flow,) = run_flow(relay.ways[:1], 1000.0, duration, 2 * DELAY)
        relay.stop()
        errors.append(judge(flow, DirectionProfile(DELAY), min(flow.sent.values())).errors)

    def quantile(values: list[Array], share: float) -> float:
        """Return the median of the rounds' quantiles [us]."""
        return 1e6 * float(np.median([np.quantile(one, share) for one in values]))

    p50, p99, wake = quantile(errors, 0.5), quantile(errors, 0.99), quantile(wakes, 0.99)
    early, how = sum(int((one < 0).sum()) for one in errors), "SCHED_FIFO" if fifo else "normal"
    return [
        Line(f"release error p50, 1 kHz, {how}", "<= 60 us", f"{p50:.1f} us", p50 <= 60),
        Line("release error p99 / C clock_nanosleep p99", "<= 1.5",
             f"{p99 / wake:.2f} ({p99:.0f} us / {wake:.0f} us)", p99 <= 1.5 * wake),
        Line("released early", "0", f"{early} of {sum(map(len, errors))}", early == 0),
    ]  # fmt: skip


def profiles(folder: Path, seconds: float) -> list[Line]:
    """Measure all shipped profiles at the same time, in both directions at 100 Hz."""
    links: dict[str, dict[str, object]] = {name: {"profile": name} for name in names("profile")}
    rows = measure_profiles(folder, links, seconds, fifo=fifo_allowed())
    judged = [row.judged for row in rows]
    every = np.concatenate([one.errors for one in judged])
    wrong = sum(one.wrongly_lost + one.wrongly_arrived for one in judged)
    swapped, early = sum(one.swapped for one in judged), int((every < 0).sum())
    (mean, biased), (spread, noisy) = (
        max((1e3 * float(abs(function(row.judged.errors))), f"{row.name} {row.direction}")
            for row in rows)
        for function in (np.mean, np.std)
    )  # fmt: skip
    return [
        Line("measured minus drawn delay, mean, worst profile", "<= 0.3 ms",
             f"{mean:.3f} ms ({biased})", mean <= 0.3),
        Line("the same, deviation, worst profile", "<= 0.5 ms",
             f"{spread:.3f} ms ({noisy})", spread <= 0.5),
        Line("lost or arrived, not as drawn", "0", f"{wrong} of {every.size}", not wrong),
        Line("out of the order drawn (by > 5 us)", "0", f"{swapped}", swapped == 0),
        Line("released early, profiles", "0", f"{early} of {every.size}", early == 0),
    ]  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
