# SPDX-License-Identifier: Apache-2.0

"""Fly random combinations of faults for a time, and check the invariants in every step.

    python -m tests.faults --minutes 10
    python -m tests.faults --minutes 5 --hostile --robot rover
    python -m tests.faults --first 201          # continue an earlier search

A schedule that breaks an invariant is stored in a file; `pytest --schedule=FILE` flies it again.
Exit codes: 0 all kept, 1 a schedule broke an invariant, 6 a worker was killed, 130 interrupted.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from cloudrc.base.text import table
from cloudrc.config import shipped
from cloudrc.config.schema import World
from cloudrc.flight.interrupts import interrupt_on_signals
from tests.faults.search import fly_seed, search, search_rows, search_summary, store
from tests.faults.trial import TrialResult


def main(words: Sequence[str] | None = None) -> int:
    """Search, and print what was found; return the exit code."""
    options = _parser().parse_args(words)
    interrupt_on_signals()
    robot = shipped.model_path("robot", options.robot, Path())
    kind = "hostile" if options.hostile else "random"
    tell = partial(print, file=sys.stderr, flush=True)
    tell(f"{kind} schedules of {robot} from {options.first} on, for {options.minutes:g} min")

    def see(finding: TrialResult) -> dict[str, Any]:
        failure = store(finding, options.store)
        tell(f"FAILED seed {failure['seed']}: {failure['breaches'][0]['text']}")
        tell(f"  again: pytest --schedule={failure['file']}")
        return failure

    fly = partial(fly_seed, hostile=options.hostile, robot=robot)
    found, stopped = search(fly, options.first, options.minutes, options.jobs, see)
    found = {"kind": kind, "robot": robot, **found}
    if options.json:
        print(json.dumps(found))
    else:
        print(f"{table(search_rows(found), right=(1, 2))}\n\n{search_summary(found)}")
    tell(f"{f'{stopped}; ' if stopped else ''}to continue, add --first {found['next']}")
    return stopped.exit_code if stopped else int(bool(found["failures"]))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m tests.faults",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("--minutes", type=float, default=1.0, help="duration (default: 1)")
    add("--first", type=int, default=1, help="first seed (default: 1)")
    add("--jobs", type=int, default=1, help="parallel processes (default: 1)")
    add("--hostile", action="store_true", help="the cloud has valid keys, and attacks")
    add("--robot", default=World().robot, help="a robot's name or path (default: %(default)s)")
    store_in = Path("build/evidence/regressions")
    add("--store", type=Path, default=store_in, help="folder for the schedules that failed")
    add("--json", action="store_true", help="print a JSON document")
    return parser


if __name__ == "__main__":
    sys.exit(main())
