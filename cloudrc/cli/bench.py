"""`cloudrc bench`: measure how much processor time the closed loop needs on this machine.

The command flies the experiment `paper`. For comparison, it also measures two other workloads: one
replays only the physics of this flight, in C (`mujoco.rollout`, one thread); the other flies the
experiment as one flight of a sweep, which also computes the metrics. The command repeats each
measurement and prints the shortest processor time.
"""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from cloudrc.cli.output import output_argument, print_result
from cloudrc.cli.parser import read_count
from cloudrc.runs.requirements import require
from cloudrc.text import table

if TYPE_CHECKING:
    pass

EPILOG = """\
'raw mj_step' replays the thrusts and the drag of the same flight in C and must
end in the same bits. Close other programs before you compare two machines; the
ratios of one run are comparable between machines."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    output_argument(parser)
    about = "how often to measure each part (default: 7)"
    parser.add_argument("--repeats", type=read_count, default=7, metavar="N", help=about)


def execute(options: argparse.Namespace) -> int:
    """Run all measurements; print for each the processor time per physics step [us]."""
    require("the bench", ("world",))
    from cloudrc.config.load import load_experiment
    from cloudrc.robots.build import describe_steps
    from cloudrc.runs.bench import LOOP, STEP, flight, measure, replay_of
    from cloudrc.runs.flight import fly_point

    experiment = load_experiment("paper")
    replay = replay_of(experiment)
    count = replay()
    parts = {
        "raw mj_step": lambda: replay,
        LOOP: lambda: flight(experiment),
        "flight of a sweep, with its numbers": lambda: lambda: (fly_point(experiment), count)[1],
    }
    costs = measure(parts, options.repeats)
    raw, steps = costs["raw mj_step"], describe_steps(experiment.world)
    figures = {
        name: {"us_per_step": cost * 1e6, "ratio": raw / cost, "real_time_factor": STEP / cost}
        for name, cost in costs.items()
    }
    rows = [("experiment paper, mode virtual", "us a step", "ratio to raw", "x real time")]
    for name, cost in costs.items():
        rows.append((name, f"{cost * 1e6:.2f}", f"{raw / cost:.3f}", f"{STEP / cost:.0f}"))
    text = f"'raw mj_step' ended in the same bits as the flight; steps of the flight: {steps}"
    document = {"physics_steps": steps, **figures}
    print_result(options.output, document, f"{table(rows, right=(1, 2, 3))}\n\n{text}")
    return 0
