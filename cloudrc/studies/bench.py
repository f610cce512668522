# SPDX-License-Identifier: Apache-2.0

"""Measure how much processor time the closed loop needs on this machine.

The measured flight is that of the experiment `paper`. For comparison, another workload replays only
the physics of this flight, in C (`mujoco.rollout`, one thread). Flights whose cloud computes more
are compared with `steps`.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np

from cloudrc.base.errors import CloudrcError
from cloudrc.base.text import table
from cloudrc.config.load import load_experiment
from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.flight.in_memory import fly_point
from cloudrc.flight.virtual.flight import assemble
from cloudrc.physics.sim.simulator import replay
from cloudrc.robots.build import describe_steps
from cloudrc.wire.records import Record

STEP = 0.002
"""Time step of the physics [s]."""
LIMIT_NS = 120_000_000_000
"""Time limit of a measured flight, in its virtual time [ns]."""
RAW, LOOP = "raw mj_step", "closed loop, records in memory"
STEPS = "steps"
FLIGHTS: dict[str, tuple[tuple[str, tuple[str, ...]], float | None]] = {
    STEPS: (("steps", ()), None),
    "steps, model_based": (("steps", ("cloud.predictor=model_based",)), 1.6),
    "fast over legs": (("fast", ("mission=legs",)), 4.0),
}
"""Name of a flight -> its experiment and settings, and the largest ratio of its processor time per
virtual time to that of `steps` that `make bench` accepts; None: any."""


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


def replay_of(experiment: ResolvedExperiment) -> Callable[[], int]:
    """Fly once; return a function that replays the physics and returns the number of steps."""
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
    _, _, teleop, run = assemble(experiment)
    records: list[Record] = []

    def sink(of_world: list[Record], of_cloud: list[Record]) -> None:
        records.extend(of_world)
        records.extend(of_cloud)

    def play() -> int:
        run.fly(lambda: teleop.over, LIMIT_NS, sink)
        return round(run.now_ns * 1e-9 / STEP)

    return play


def bench(repeats: int) -> dict[str, Any]:
    """Measure the replay of the physics, the loop, a flight of a sweep, and FLIGHTS.

    Repeat each `repeats` times. Return the figures of each by its name, and which step flew.
    """
    experiment = load_experiment("paper")
    replayed = replay_of(experiment)
    count = replayed()
    parts = {
        RAW: lambda: replayed,
        LOOP: lambda: flight(experiment),
        "flight of a sweep, with its numbers": lambda: lambda: (fly_point(experiment), count)[1],
    }
    for name, ((other, settings), _) in FLIGHTS.items():
        parts[name] = partial(flight, load_experiment(other, settings))
    costs = measure(parts, repeats)
    flights = {name: costs.pop(name) / STEP for name in FLIGHTS}
    figures = {
        name: {
            "us_per_step": cost * 1e6,
            "ratio": costs[RAW] / cost,
            "real_time_factor": STEP / cost,
        }
        for name, cost in costs.items()
    }
    beside = {
        name: {"ms_per_second": cost * 1e3, "ratio_to_steps": cost / flights[STEPS]}
        for name, cost in flights.items()
    }
    return {"physics_steps": describe_steps(experiment.world), **figures, "flights": beside}


def as_text(document: Mapping[str, Any]) -> str:
    """Format the result of `bench` for people."""
    rows = [("experiment paper, mode virtual", "us a step", "ratio to raw", "x real time")]
    for name, each in document.items():
        if name not in ("physics_steps", "flights"):
            cost, ratio = f"{each['us_per_step']:.2f}", f"{each['ratio']:.3f}"
            rows.append((name, cost, ratio, f"{each['real_time_factor']:.0f}"))
    steps = document["physics_steps"]
    text = f"'{RAW}' ended in the same bits as the flight; steps of the flight: {steps}"
    flights = [("flights, records in memory", "ms a second", "ratio to steps")]
    for name, each in document["flights"].items():
        flights.append((name, f"{each['ms_per_second']:.1f}", f"{each['ratio_to_steps']:.2f}"))
    both = table(rows, right=(1, 2, 3)), table(flights, right=(1, 2))
    return "\n\n".join((*both, text))
