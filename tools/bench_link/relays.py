"""Measure the delays of `cloudrc relay`, and how late a program in C wakes."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np

from cloudrc.assembly import link_profile
from cloudrc.config.load import load_experiment
from cloudrc.drivers.realtime import free_ports
from cloudrc.errors import MissingPrerequisiteError
from cloudrc.link.profile import DirectionProfile
from tools.bench_link.flow import SEED, Array, Flow, Judged, Way, judge, run_flow

Links: TypeAlias = dict[str, dict[str, object]]
"""Name -> the section `link` of an experiment file."""


class RelayProcess:
    """A running `cloudrc relay`; `ways` has the addresses of both directions."""

    def __init__(self, folder: Path, link: dict[str, object], *, fifo: bool = False) -> None:
        """Start a relay and wait until it is ready; `link` is that section of an experiment."""
        config = _write(folder, link)
        world_side, cloud_side, world, cloud = (("127.0.0.1", port) for port in free_ports(4))
        addresses = {
            "world-side": world_side, "cloud-side": cloud_side, "world": world, "cloud": cloud
        }  # fmt: skip
        command = [sys.executable, "-m", "cloudrc", "relay", f"--config={config}", "--feed"]
        command += [f"--{name}={host}:{port}" for name, (host, port) in addresses.items()]
        command += ["--fifo"] if fifo else []
        self.ways = [Way(True, world_side, cloud, world), Way(False, cloud_side, world, cloud)]
        self._process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        assert self._process.stdout is not None
        self._process.stdout.readline()

    def stop(self) -> None:
        """Stop the relay."""
        self._process.terminate()
        self._process.communicate(timeout=10)


def compile_program(folder: Path) -> Path:
    """Compile wake_lateness.c into a folder, and return the program.

    Raises:
        MissingPrerequisiteError: If there is no C compiler.
    """
    if shutil.which("cc") is None:
        raise MissingPrerequisiteError(
            "bench-link compiles a program in C and finds no 'cc'; apt-get install gcc"
        )
    program = folder / "wake_lateness"
    source = Path(__file__).parent / "wake_lateness.c"
    subprocess.run(["cc", "-O2", "-o", str(program), str(source)], check=True)
    return program


def wake_lateness(program: Path, count: int, *, fifo: bool) -> Array:
    """Let the program sleep until instants 1 ms apart; return its late wakes [s], (count,)."""
    command = [*(("chrt", "-f", "10") if fifo else ()), str(program), str(count)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return np.array(done.stdout.split(), dtype=float) * 1e-9


def fifo_allowed() -> bool:
    """Return whether this user may run programs under SCHED_FIFO."""
    if shutil.which("chrt") is None:
        return False
    done = subprocess.run(["chrt", "-f", "10", "true"], capture_output=True, check=False)
    return done.returncode == 0


class Row(NamedTuple):
    """Result of one direction of one profile."""

    name: str
    direction: str
    judged: Judged


def measure_profiles(folder: Path, links: Links, duration: float, *, fifo: bool) -> list[Row]:
    """Send through several links at the same time, both ways at 100 Hz, for `duration` [s].

    Returns:
        Two rows for each link.
    """
    relays = {name: RelayProcess(folder, link, fifo=fifo) for name, link in links.items()}
    # Begin when all senders run: the start of a sender takes 0.6 s of CPU time from the others.
    begin = time.monotonic() + 0.6 * (len(links) + 1)
    tasks = [(relay.ways, duration, begin) for relay in relays.values()]
    with ProcessPoolExecutor(len(tasks), mp_context=get_context("spawn")) as pool:
        flows = dict(zip(relays, pool.map(_send, tasks), strict=True))
    rows: list[Row] = []
    for name, relay in relays.items():
        relay.stop()
        origin_ns = min(min(flow.sent.values()) for flow in flows[name])
        for flow, profile in zip(flows[name], profiles_of(folder, links[name]), strict=True):
            direction = "uplink" if flow.uplink else "downlink"
            rows.append(Row(name, direction, judge(flow, profile, origin_ns)))
    return rows


def _send(task: tuple[list[Way], float, float]) -> list[Flow]:
    ways, duration, begin = task
    return run_flow(ways, 100.0, duration, 1.2, begin)


def profiles_of(folder: Path, link: dict[str, object]) -> tuple[DirectionProfile, DirectionProfile]:
    """Read the profiles of a link: uplink, downlink."""
    experiment = load_experiment(str(_write(folder, link)))
    return link_profile(experiment.uplink), link_profile(experiment.downlink)


def _write(folder: Path, link: dict[str, object]) -> Path:
    """Write an experiment file with a link."""
    path = folder / f"{link.get('profile', 'link')}-{len(list(folder.iterdir()))}.yaml"
    world = {"mission": "hover", "world": {"scene": "empty"}}
    path.write_text(json.dumps({"seed": SEED, **world, "link": link}))
    return path
