# SPDX-License-Identifier: Apache-2.0

"""Measure how long a controller computes a command, for `cloud.compute_ms`."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cloudrc.base.errors import NothingFlownError
from cloudrc.base.outside.code import apart
from cloudrc.cloud.compute_time import ComputeTime
from cloudrc.flight.assembly.link import build_links
from cloudrc.flight.experiment import load
from cloudrc.flight.interrupts import raise_if_interrupted
from cloudrc.flight.virtual.flight import assemble
from cloudrc.results.report.folder import read_run
from cloudrc.studies.cpu_limit import PacedClock, cpu_limit
from cloudrc.wire.messages import plan_length
from cloudrc.wire.tunnel.codec import COMMAND_SIZES, Kind

ARRIVAL = "epoch", "counter", "delay"
"""Columns of the topic /downlink_delay."""


class MeasuredTimes(NamedTuple):
    """Measured durations."""

    times_ms: list[float]
    where: str  # what was measured, and how
    unlimited: str = ""  # why there was no CPU limit


class _Kept(ComputeTime):
    """Keeps all durations."""

    def __init__(self, clock: PacedClock) -> None:
        super().__init__(0.0, 0.0, np.random.default_rng(0), clock)
        self.times_ms = list[float]()

    def end(self, began_ns: int) -> int:
        duration_ns = super().end(began_ns)
        self.times_ms.append(duration_ns * 1e-6)
        return duration_ns


@apart()
def of_controller(
    controller: str, settings: list[str], cpus: float | None, seconds: float
) -> MeasuredTimes:
    """Measure a controller in real time, in a flight of at most `seconds` [s].

    World flies in this process, too, and needs about 0.01 processors of the limit. `cpus` is this
    limit, in processors [1]; None: no limit.
    """
    experiment = load("steps", [f"cloud.controller={controller}", *settings])
    clock = PacedClock()
    kept = _Kept(clock)
    *_, teleop, run = assemble(experiment, compute=kept)
    clock.virtual_ns = lambda: run.now_ns
    with nullcontext("") if cpus is None else cpu_limit(cpus) as unlimited:
        run.fly(lambda: teleop.over, round(seconds * 1e9), lambda *_: raise_if_interrupted())
    limit = "" if cpus is None or unlimited else f", limited to {cpus:g} CPUs"
    where = f"{controller}, {experiment.cloud.command_rate_hz} Hz{limit}"
    return MeasuredTimes(kept.times_ms, where, unlimited)


def of_run(folder: Path) -> MeasuredTimes:
    """Take the durations from the recording of a run: real time, or `cloud.compute_measured`."""
    recording, experiment, _ = read_run(folder)
    rows = recording["/lateness"]
    if len(rows):
        busy = rows["busy"][rows["end"] == "cloud"]
        return MeasuredTimes((busy * 1e3).tolist(), f"periods of cloud's loop in {folder}")
    link, arrived = build_links(experiment)[1], recording["/downlink_delay"]
    if not experiment.cloud.compute_measured or link.only is None or experiment.is_fleet:
        text = "needs a flight in real time, or one with cloud.compute_measured and a link without"
        raise NothingFlownError(f"{folder}: {text} a rate, keep_order and a schedule")
    size = COMMAND_SIZES[plan_length(experiment.cloud.plan_s)]
    times_ms = list[float]()
    for epoch, counter, delay in zip(*(arrived[name].tolist() for name in ARRIVAL), strict=True):
        own_ns = link.send(epoch, Kind.COMMAND, counter, size, 0)
        if len(own_ns) == 1:  # of a duplicate, one does not know which copy it is
            times_ms.append(max(0.0, delay * 1e3 - own_ns[0] * 1e-6))
    return MeasuredTimes(times_ms, f"commands in {folder}")
