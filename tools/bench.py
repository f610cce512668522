# SPDX-License-Identifier: Apache-2.0

"""`make bench`: how much processor time does a flight cost, and has a change made it cheaper?

    make bench                      # flights beside `steps`, with sensors, steps of `Networked`
    make bench AGAINST=COMMIT       # the loop and a sweep's flight, beside those of another commit
    make bench AGAINST=COMMIT FLIGHTS=20 ROWS=fast      # the rows that have this word in their name

The numbers hold on a machine that others use, too: a flight is cut into pieces of 100 ms of virtual
time, and the shortest processor time of each piece in at least 12 flights counts. Flights that are
compared take turns. The interval has 95 % of the ratios of flights that are drawn from those flown.
Exit codes: 0 all ratios are as asked; 1 a ratio is larger; 2 there is no such commit or row.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from ctypes.util import find_library
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from numpy.typing import NDArray

from cloudrc.base.text import table
from cloudrc.gym import Channel, Networked
from cloudrc.studies.bench import FLIGHTS, STEPS

ROOT = Path(__file__).parents[1]
FLIGHTS_MIN = 12
"""Smallest number of flights: with fewer, other programs disturb a piece in all of them."""
DRAWS = 400
"""Number of draws for an interval."""
LEGS = ("mission=legs",)
ROWS = {
    "paper, loop": ("paper", (), "loop", None),
    "paper, flight of a sweep": ("paper", (), "sweep", None),
}
"""Rows beside another commit: experiment, settings, part, and the largest ratio that is asked."""
KINDS = {
    **{
        name: (*flight, "loop", most) for name, (flight, most) in FLIGHTS.items()
    },  # also cloudrc bench
    "steps, command_history": ("steps", ("cloud.predictor=command_history",), "loop", None),
    "steps, kalman": ("steps", ("cloud.predictor=kalman",), "loop", 1.9),
    "steps, x2": ("steps", ("world.robot=x2",), "loop", 1.7),
    "steps, nano": ("steps", ("world.robot=nano",), "loop", 1.7),
    "pillars, rover": ("pillars", (), "loop", 1.9),
    "fast over legs, mpc": ("fast", (*LEGS, "cloud.controller=mpc"), "loop", 7.0),
    "fast over legs, x2": ("fast", (*LEGS, "world.robot=x2"), "loop", None),
}
"""Rows beside `steps`, likewise."""
NO_YES = "false", "true"
AWAY = "{position_m: [2, 0, 0.1]}, {position_m: [0, 0, 0.1]}"
SHORT = ("cloud.perception=null", f"mission.waypoints=[{AWAY}, {AWAY}, {AWAY}]")
"""`gap` by waypoints before the first pillar: the same way with scans and without them."""
SCANS = {"corridor": (SHORT, 0.1), "pipes": ((*SHORT, "world.scene=pipes"), None)}
"""Scene -> settings of flights with scans, and the largest share of a flight of `gap`."""
ENVIRONMENTS = "CartPole-v1", "Pendulum-v1"
STEP_MAX = 20.0
"""Largest processor time of a step of `Networked`, without the environment's [us]."""
FOLLOW = "run", "follow", "--mode", "virtual"
FOLLOW_MAX = 20.0
"""Largest processor time of this command, 40 s with 15 pictures a second and its report [s]."""
ROBOTS, ROBOT_STEPS, CHANNEL_MAX = 20, 2_000, 1.3
"""Robots that share a channel; their steps; largest cost of one's step in steps of `Networked`."""


class Measured(NamedTuple):
    """The flights of one row in one work tree."""

    pieces: NDArray[np.float64]  # processor time [s], shape (flights, pieces)
    seconds: float  # virtual time of a flight [s]
    sha256: str

    def cost(self, flights: Any = slice(None)) -> float:
        """Return the processor time per virtual time [1] of some flights, by default of all."""
        return float(self.pieces[flights].min(axis=0).sum()) / self.seconds


class Tree:
    """A work tree, and the process that flies with its sources."""

    def __init__(self, sources: Path, cache: Path) -> None:
        """Start the process; `cache` is the folder for its own compiled step."""
        worker = str(Path(__file__).with_name("bench_worker.py"))
        self._process = subprocess.Popen(
            [sys.executable, "-P", worker],
            env={**os.environ, "PYTHONPATH": str(sources), "XDG_CACHE_HOME": str(cache)},
            cwd=sources,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def __enter__(self) -> Tree:
        return self

    def __exit__(self, *error: object) -> None:
        self._process.communicate()

    def fly(self, flight: Sequence[Any]) -> dict[str, Any]:
        """Fly once; return what `bench_worker.py` answers."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        print(json.dumps(flight), file=self._process.stdin, flush=True)
        found: dict[str, Any] = json.loads(self._process.stdout.readline())
        return found


def measure(pairs: Sequence[tuple[Tree, Sequence[Any]]], flights: int) -> list[Measured]:
    """Let each tree fly its flight, in turns; return what the flights have cost."""
    found = [[tree.fly(flight) for tree, flight in pairs] for _ in range(flights)]
    return [
        Measured(np.array([each["pieces"] for each in row]), row[0]["seconds"], row[0]["sha256"])
        for row in zip(*found, strict=True)
    ]


def interval(of: Measured, to: Measured) -> tuple[float, float]:
    """Return the limits of 95 % of the ratios of two costs, for flights drawn from those flown."""
    draws, count = np.random.default_rng(0), len(of.pieces)
    drawn = draws.integers(count, size=(2, DRAWS, count))
    ratios = [of.cost(a) / to.cost(b) for a, b in zip(*drawn, strict=True)]
    low, high = np.percentile(ratios, (2.5, 97.5))
    return float(low), float(high)


@contextmanager
def checked_out(commit: str, folder: Path) -> Iterator[Path]:
    """Give a work tree of a commit to the block."""
    git = ["git", "-C", str(ROOT), "worktree"]
    subprocess.run([*git, "add", "--quiet", "--detach", str(folder), commit], check=True)
    try:
        yield folder
    finally:
        subprocess.run([*git, "remove", "--force", str(folder)], check=True)


def judged(value: float, most: float | None) -> tuple[str, str]:
    """Return the last two cells of a row: what is asked, and whether it is missed."""
    if most is None:
        return "", ""
    return f"<= {most:g}", "MISSED" if value > most else ""


def row(name: str, of: Measured, to: Measured, most: float | None) -> tuple[str, ...]:
    """Return the cells of a row: two costs, and their ratio."""
    ratio, (low, high) = of.cost() / to.cost(), interval(of, to)
    costs = f"{1e3 * of.cost():.2f}", f"{1e3 * to.cost():.2f}"
    return (name, *costs, f"{ratio:.3f}", f"{low:.3f} to {high:.3f}", *judged(ratio, most))


def against(commit: str, names: Sequence[str], flights: int) -> list[tuple[str, ...]]:
    """Fly rows with these sources and with those of another commit."""
    rows: list[tuple[str, ...]] = [("", "ms per s", f"at {commit}", "ratio", "interval", "hashes")]
    with tempfile.TemporaryDirectory() as made, ExitStack() as stack:
        folder = Path(made)
        other = stack.enter_context(checked_out(commit, folder / "tree"))
        trees = [Tree(ROOT, folder / "here"), Tree(other, folder / "there")]
        for tree in trees:
            stack.enter_context(tree)
        for name in names:
            *flight, _ = {**ROWS, **KINDS}[name]
            here, there = measure([(tree, flight) for tree in trees], flights)
            same = "equal" if here.sha256 == there.sha256 else "DIFFERENT"
            rows.append((*row(name, here, there, None)[:5], same))
    return rows


def beside_steps(names: Sequence[str], flights: int) -> list[tuple[str, ...]]:
    """Fly rows beside `steps`, with these sources."""
    rows: list[tuple[str, ...]] = [("", "ms per s", "of steps", "ratio", "interval", "asked", "")]
    with tempfile.TemporaryDirectory() as cache, Tree(ROOT, Path(cache)) as tree:
        flown = [(tree, KINDS[name][:3]) for name in (STEPS, *names)]
        steps, *others = measure(flown, flights)
        for name, found in zip(names, others, strict=True):
            rows.append(row(name, found, steps, KINDS[name][3]))
    return rows


def scans(flights: int) -> list[tuple[str, ...]]:
    """Measure what scans cost: the share of a sweep's flight of `gap` that has none."""
    head = "181 rays at 10 Hz, sweep", "ms per s", "gap without", "share", "asked", ""
    rows: list[tuple[str, ...]] = [head]
    with tempfile.TemporaryDirectory() as cache, Tree(ROOT, Path(cache)) as tree:
        pairs: list[Sequence[Any]] = [("gap", (), "sweep")]
        for settings, _ in SCANS.values():
            pairs += [("gap", (*settings, f"world.scan={each}"), "sweep") for each in NO_YES]
        whole, *both = (each.cost() for each in measure([(tree, each) for each in pairs], flights))
    more = [scanned - bare for bare, scanned in zip(both[::2], both[1::2], strict=True)]
    without = whole - more[0]
    for (name, (_, most)), cost in zip(SCANS.items(), more, strict=True):
        share, costs = cost / without, (f"{1e3 * cost:.2f}", f"{1e3 * without:.2f}")
        rows.append((name, *costs, f"{share:.3f}", *judged(share, most)))
    return rows


def steps_of(env: Any, actions: Sequence[Any]) -> list[float]:
    """Return the processor time of each step [s], in the same episodes with each call."""
    env.reset(seed=0)
    spent = list[float]()
    for action in actions:
        before = time.thread_time()
        *_, terminated, truncated, _ = env.step(action)
        spent.append(time.thread_time() - before)
        if terminated or truncated:
            env.reset(seed=0)
    return spent


def step_of_networked(name: str, steps: int = 1000, repeats: int = FLIGHTS_MIN) -> float:
    """Return what a step of `Networked` over `lte` costs, without that of its environment [us]."""
    envs = gymnasium.make(name), Networked(gymnasium.make(name), "lte")
    envs[0].action_space.seed(0)
    actions = [envs[0].action_space.sample() for _ in range(steps)]
    spent = np.array([[steps_of(env, actions) for env in envs] for _ in range(repeats)])
    bare, whole = spent.min(axis=0).mean(axis=1) * 1e6
    return float(whole - bare)


def networked() -> list[tuple[str, ...]]:
    """Measure steps of `Networked`."""
    rows: list[tuple[str, ...]] = [("Networked, lte, of its own", "us a step", "asked", "")]
    for name in ENVIRONMENTS:
        cost = step_of_networked(name)
        rows.append((name, f"{cost:.1f}", *judged(cost, STEP_MAX)))
    return rows


def of_channel(count: int, steps: int) -> Iterator[None]:
    """Play `count` pendulums that share a channel; yield after each of their steps."""
    envs = [gymnasium.make("Pendulum-v1", max_episode_steps=steps) for _ in range(count)]
    channel = Channel(envs, "lte")
    for robot, seen, info in channel.play(1, steps * channel.dt[0]):
        if info["cloudrc"]["asked"]:
            channel.answer(robot, -4.0 * seen[1:2] - seen[2:])
        if robot == count - 1:
            yield


def of_networked(steps: int) -> Iterator[None]:
    """Play one pendulum alone; yield after each of its steps."""
    env = Networked(gymnasium.make("Pendulum-v1", max_episode_steps=steps), "lte")
    seen, info = env.reset(seed=1)
    for _ in range(steps):
        if info["cloudrc"]["asked"]:
            action = -4.0 * seen[1:2] - seen[2:]
        seen, *_, info = env.step(action)
        yield


def shared(repeats: int = 5) -> list[tuple[str, ...]]:
    """Measure a robot's step on a shared channel beside a step of `Networked`."""

    def cost(make: Callable[[], Iterator[None]]) -> float:
        spent = list[NDArray[np.float64]]()
        for _ in range(repeats):
            spent.append(np.diff([time.thread_time() for _ in make()]))
        return float(np.min(spent, axis=0).mean())

    alone = cost(partial(of_networked, ROBOT_STEPS))
    ratio = cost(partial(of_channel, ROBOTS, ROBOT_STEPS)) / ROBOTS / alone
    return [
        ("Channel, lte, step of a robot", "x alone", "asked", ""),
        (f"{ROBOTS} Pendulum-v1", f"{ratio:.2f}", *judged(ratio, CHANNEL_MAX)),
    ]


def camera(repeats: int = 3) -> list[tuple[str, ...]]:
    """Measure a flight with a camera, as its user types it."""
    if find_library("EGL") is None:
        return [("with a camera: not measured, needs libegl1 and libgl1-mesa-dri",)]
    spent = list[float]()
    for _ in range(repeats):
        before = sum(os.times()[2:4])
        with tempfile.TemporaryDirectory() as made:
            words = [sys.executable, "-m", "cloudrc", *FOLLOW, "--out", f"{made}/run"]
            subprocess.run(words, check=True, stdout=subprocess.DEVNULL)
        spent.append(sum(os.times()[2:4]) - before)
    name = f"cloudrc {' '.join(FOLLOW)}"
    return [
        ("with a camera", "processor time [s]", "asked", ""),
        (name, f"{min(spent):.1f}", *judged(min(spent), FOLLOW_MAX)),
    ]


def main() -> int:
    """Measure, print the results and return the exit code."""
    parser = argparse.ArgumentParser(prog="make bench", description=__doc__)
    parser.add_argument("--against", metavar="COMMIT", default="")
    parser.add_argument("--flights", type=int, default=FLIGHTS_MIN)
    parser.add_argument("--rows", metavar="WORD", default="")
    options = parser.parse_args()
    if options.flights < FLIGHTS_MIN:
        parser.error(f"FLIGHTS={options.flights}: at least {FLIGHTS_MIN} flights are needed")
    every = {**ROWS, **KINDS} if options.rows else ROWS if options.against else KINDS
    names = [name for name in every if options.rows in name and (options.against or name in KINDS)]
    if not names:
        parser.error(f"ROWS={options.rows}: the rows are {'; '.join({**ROWS, **KINDS})}")
    if options.against:
        tables = [against(options.against, names, options.flights)]
    else:
        names = [name for name in names if name != STEPS]
        tables = [beside_steps(names, options.flights)]
        tables += [] if options.rows else [scans(options.flights), networked(), shared(), camera()]
    for rows in tables:
        print(table(rows, right=range(1, 5)), end="\n\n", flush=True)
    return int(any("MISSED" in row for rows in tables for row in rows))


if __name__ == "__main__":
    sys.exit(main())
