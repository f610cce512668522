"""`cloudrc bench`: measure how much processor time the closed loop needs on this machine.

The command flies the experiment `paper`. For comparison, it also measures two other workloads: one
replays only the physics of this flight, in C (`mujoco.rollout`, one thread); the other flies the
experiment as one flight of a sweep, which also computes the metrics. The command repeats each
measurement and prints the shortest processor time.
"""

from __future__ import annotations

import argparse
import gc
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from cloudrc.cli.output import output_argument, print_result
from cloudrc.cli.parser import read_count
from cloudrc.errors import CloudrcError
from cloudrc.runs.requirements import require
from cloudrc.text import table

if TYPE_CHECKING:
    from cloudrc.config.load import ResolvedExperiment
    from cloudrc.records import Record

STEP = 0.002
"""Time step of the physics [s]."""
LIMIT_NS = 120_000_000_000
"""Time limit of a measured flight, in its virtual time [ns]."""
LOOP = "closed loop, records in memory"
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
    from cloudrc.runs.flight import fly_point

    experiment = load_experiment("paper")
    replay = _replay(experiment)
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


def measure(parts: dict[str, Callable[[], Callable[[], int]]], repeats: int) -> dict[str, float]:
    """Repeat measurements; return name -> shortest processor time per physics step [s].

    `parts` maps the name to a function that prepares one measurement and returns a second function.
    Only the second function is timed; it returns the number of physics steps.
    """
    shortest: dict[str, float] = {}
    for _ in range(repeats):
        for name, prepare in parts.items():
            work = prepare()
            gc.collect()
            start = time.process_time()
            steps = work()
            cost = (time.process_time() - start) / steps
            shortest[name] = min(cost, shortest.get(name, cost))
    return shortest


def _replay(experiment: ResolvedExperiment) -> Callable[[], int]:
    """Fly once; return a function that replays the physics and returns the number of steps."""
    import numpy as np

    from cloudrc.assembly import assemble
    from cloudrc.world.simulator import replay

    world, _, teleop, run = assemble(experiment)
    simulator = world.robot.simulator
    start, simulator.tape = simulator.state(), []
    run.fly(lambda: teleop.over, LIMIT_NS, lambda of_world, of_cloud: None)
    tape, end = np.array(simulator.tape), simulator.state()[0]

    def play() -> int:
        if (replay(simulator.model, *start, tape) != end).any():
            raise CloudrcError("the replay does not end in the state of the flight; report this")
        return len(tape)

    return play


def flight(experiment: ResolvedExperiment) -> Callable[[], int]:
    """Prepare a flight; return a function that flies and returns the number of physics steps."""
    from cloudrc.assembly import assemble

    _, _, teleop, run = assemble(experiment)
    records: list[Record] = []

    def sink(of_world: list[Record], of_cloud: list[Record]) -> None:
        records.extend(of_world)
        records.extend(of_cloud)

    def play() -> int:
        run.fly(lambda: teleop.over, LIMIT_NS, sink)
        return round(run.now_ns * 1e-9 / STEP)

    return play
