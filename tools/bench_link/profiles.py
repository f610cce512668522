"""Every shipped profile through the relay, all at once: what came against what the model drew."""

from __future__ import annotations

import json
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np

from cloudrc.assembly import link_profile
from cloudrc.config.load import load_experiment
from cloudrc.link.profile import DirectionProfile, Trace
from tools.bench_link.flow import Flow, Way, run_flow
from tools.bench_link.judge import Judged, judge
from tools.bench_link.relays import ours

SEED = 1
TAIL = 1.2
"""Longer than any shipped delay [s]."""
START_EACH = 0.6
"""For a process to come up that sounds a link [s]."""

Links: TypeAlias = dict[str, dict[str, object]]
"""Name -> the section `link` of an experiment file."""


class Row(NamedTuple):
    """One direction of one profile.

    Attributes:
        name: Of the profile.
        direction: "uplink" or "downlink".
        judged: What came of it.
        own_p99: The relay's own 99th percentile of its release error, both ways [s].
    """

    name: str
    direction: str
    judged: Judged
    own_p99: float


@dataclass(frozen=True)
class Task:
    """A link that is up.

    Attributes:
        ways: How to send through it.
        rate: On each way [1/s].
        duration: [s].
        begin: When to begin [s], monotonic clock.
    """

    ways: tuple[Way, ...]
    rate: float
    duration: float
    begin: float


def measure(
    folder: Path, links: Links, duration: float, rate: float = 100.0, *, fifo: bool = False
) -> list[Row]:
    """Sound links, all at the same time, both ways.

    Args:
        folder: For files.
        links: What they are.
        duration: Of the sending [s].
        rate: On each way [1/s].
        fifo: Whether the relays run under SCHED_FIFO.

    Returns:
        Two rows for each link.
    """
    flags = ("--fifo",) if fifo else ()
    relays = {name: ours(folder, link, *flags) for name, link in links.items()}
    # Once all processes are up: to start one takes processor time from the others.
    begin = time.monotonic() + START_EACH * (len(links) + 1)
    tasks = [Task(tuple(one.ways), rate, duration, begin) for one in relays.values()]
    with ProcessPoolExecutor(len(tasks), mp_context=get_context("spawn")) as pool:
        flows = dict(zip(relays, pool.map(_sound, tasks), strict=True))
    rows: list[Row] = []
    for name, relay in relays.items():
        relay.stop()
        own_p99 = relay.counts().get("release_error_p99", 0.0)
        origin_ns = min(min(flow.sent.values()) for flow in flows[name])
        for flow, profile in zip(flows[name], profiles_of(folder, links[name]), strict=True):
            direction = "uplink" if flow.uplink else "downlink"
            rows.append(Row(name, direction, judge(flow, profile, SEED, origin_ns), own_p99))
    return rows


def profiles_of(folder: Path, link: dict[str, object]) -> tuple[DirectionProfile, DirectionProfile]:
    """Read what a link asks for: uplink, downlink."""
    path = folder / "asked.yaml"
    path.write_text(json.dumps({"seed": SEED, "mission": "hover", "link": link}))
    experiment = load_experiment(str(path))
    return link_profile(experiment.uplink), link_profile(experiment.downlink)


def random_walk(duration: float) -> Trace:
    """Make a trace of delays: a random walk about 40 ms in steps of 0.1 s, seeded."""
    generator, delays = np.random.default_rng(5), [0.040]
    for _ in range(round(duration * 10)):
        delay = delays[-1] + 0.004 * generator.standard_normal()
        delays.append(round(min(max(delay, 0.005), 0.120), 6))
    return Trace(tuple(number / 10 for number in range(len(delays))), tuple(delays))


def correlation(judged: Judged, trace: DirectionProfile) -> float:
    """Say how like a trace the delays are that were measured when it was replayed."""
    assert trace.trace is not None
    times, delays = np.array(trace.trace.times), np.array(trace.trace.delays)
    asked = delays[np.clip(np.searchsorted(times, judged.sent, "right") - 1, 0, None)]
    return float(np.corrcoef(asked, judged.measured)[0, 1])


def _sound(task: Task) -> list[Flow]:
    return run_flow(task.ways, task.rate, task.duration, TAIL, task.begin)
