# SPDX-License-Identifier: Apache-2.0

"""Print how many calls it takes to load, advise on, assemble and fly an experiment, warm.

    python -m tools.calls [EXPERIMENT]

The counts are the same on every machine with the same packages, so they show what a change costs
without a clock: of cloudrc's own functions, and of all, also those in C.
"""

import sys
from collections.abc import Callable
from types import FrameType
from typing import Any

from cloudrc.config.load import load_experiment
from cloudrc.flight.virtual.flight import assemble
from cloudrc.flight.warnings import advise
from cloudrc.studies.bench import flight


def count(
    work: Callable[[], Any], prepare: Callable[[], Any] | None = None
) -> tuple[Any, int, int]:
    """Return what `work` returns, and the calls of cloudrc's functions and of all functions.

    `prepare` makes a new `work`, for work that can be done once.
    """
    work()  # imports, and caches
    work = prepare() if prepare else work
    own = every = 0

    def see(frame: FrameType, event: str, _: object) -> None:
        nonlocal own, every
        every += event in ("call", "c_call")
        if event == "call":
            own += f"{frame.f_globals.get('__name__')}".startswith("cloudrc.")

    sys.setprofile(see)
    try:
        result = work()
    finally:
        sys.setprofile(None)
    return result, own, every


def main(name: str) -> None:
    """Count, and print a line for each step."""
    experiment, *calls = count(lambda: load_experiment(name))
    steps = {
        "load": calls,
        "advise": count(lambda: advise(experiment))[1:],
        "assemble": count(lambda: assemble(experiment))[1:],
        "fly": count(flight(experiment), lambda: flight(experiment))[1:],
    }
    print(f"{'step':10}{'cloudrc':>10}{'all':>10}")
    for step, (own, every) in steps.items():
        print(f"{step:10}{own:10,}{every:10,}")


if __name__ == "__main__":
    main(sys.argv[1] if sys.argv[1:] else "paper")
