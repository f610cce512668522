# SPDX-License-Identifier: Apache-2.0

"""Fly for `tools/bench.py`, with the sources that PYTHONPATH names: of this or of another commit.

Each line of stdin is a flight as JSON: [experiment, settings, part]. Each line of stdout answers
with the processor time of its pieces [s], its virtual time [s] and the hash of its records. The
part "loop" is the flight in memory; the part "sweep" is a flight of a sweep, whose first piece
builds the flight, and whose last one computes the metrics.

This file names what it needs of cloudrc at two places, that of today and that of older commits.
"""

from __future__ import annotations

import gc
import json
import os
import sys
import time
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from itertools import pairwise, repeat
from typing import Any

LIMIT_NS = 300_000_000_000
"""Time limit of a flight of the part "loop" [ns], virtual time."""
FLY_POINT = "cloudrc.flight.in_memory", "cloudrc.runs.flight"
WORKERS = "cloudrc.flight.trials.workers", "cloudrc.trials.workers"
VIRTUAL = "cloudrc.flight.virtual.run", "cloudrc.drivers.virtual"
ASSEMBLY = "cloudrc.flight.virtual.flight", "cloudrc.assembly"
"""Where the modules that fly are today, and where they were in older commits."""
marks: list[float] = []
"""Processor time of this thread when the flight began, and every 100 ms of virtual time [s]."""


def load_module(names: tuple[str, ...]) -> Any:
    """Import the first of some modules that is there."""
    for name in names:
        try:
            return import_module(name)
        except ModuleNotFoundError as error:
            if not name.startswith(f"{error.name}"):
                raise
    raise ModuleNotFoundError(" and ".join(names))


def note_pieces() -> None:
    """Let every flight in virtual time note when a piece of it ends."""
    run = load_module(VIRTUAL).VirtualRun
    fly = run.fly

    def fly_noted(self: Any, until: Any, limit_ns: int, sink: Any) -> None:
        def noted(*records: Any) -> None:
            sink(*records)
            marks.append(time.thread_time())

        marks.append(time.thread_time())
        fly(self, until, limit_ns, noted)

    run.fly = fly_noted


@cache
def load(experiment: str, settings: tuple[str, ...]) -> Any:
    """Load an experiment, once."""
    from cloudrc.config.load import load_experiment

    return load_experiment(experiment, settings)


def fly_point(experiment: Any) -> str:
    """Fly as a sweep does; return the hash of the records, or the reason for none."""
    row = load_module(FLY_POINT).fly_point(experiment)
    return str(row["records_sha256"] or row)


@cache
def flights(experiment: str, settings: tuple[str, ...]) -> Iterator[str]:
    """Yield the hash of one flight after the other, as a worker of a sweep flies them."""
    again = repeat(load(experiment, settings))
    return load_module(WORKERS).map_in_order(fly_point, again, 1)  # type: ignore[no-any-return]


def fly_loop(experiment: Any) -> None:
    """Fly, and keep the records in memory."""
    _, _, teleop, run, *_ = load_module(ASSEMBLY).assemble(experiment)
    records: list[Any] = []

    def sink(*new: list[Any]) -> None:
        for each in new:
            records.extend(each)

    gc.collect()
    run.fly(lambda: teleop.over, LIMIT_NS, sink)


@cache
def hash_of(experiment: str, settings: tuple[str, ...]) -> str:
    """Return the hash of a flight's records, of one flight that nobody measures."""
    return fly_point(load(experiment, settings))


def measure(experiment: str, settings: tuple[str, ...], part: str) -> dict[str, Any]:
    """Fly once; return what the flight has cost."""
    sha256, resolved = hash_of(experiment, settings), load(experiment, settings)
    gc.collect()
    marks.clear()
    before = time.thread_time()
    next(flights(experiment, settings)) if part == "sweep" else fly_loop(resolved)
    after = time.thread_time()
    ends = [before, *marks, after] if part == "sweep" else marks
    pieces = [end - begin for begin, end in pairwise(ends)]
    return {"pieces": pieces, "seconds": 0.1 * (len(marks) - 1), "sha256": sha256}


def main() -> None:
    """Answer until stdin ends."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what a flight prints is no answer
    note_pieces()
    for line in sys.stdin:
        experiment, settings, part = json.loads(line)
        print(json.dumps(measure(experiment, tuple(settings), part)), file=answers, flush=True)


if __name__ == "__main__":
    main()
