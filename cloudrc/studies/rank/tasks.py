# SPDX-License-Identifier: Apache-2.0

"""What a version of the ranking pins: tasks, links, round trips, seeds and executors.

Whoever changes one of them gives the ranking a new version: entries of two versions are not
compared.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

from cloudrc.base.outside.document import read_document
from cloudrc.base.requirements import SIM, missing
from cloudrc.config.shipped import FOLDERS
from cloudrc.flight.own_files import DIGITS

VERSION = "1"
GRID = (0.0, 10.0, 20.0, 50.0, 100.0, 150.0, 200.0, 300.0, 450.0, 600.0)
"""Round trips [ms]: constant delays, half each way."""
LINKS = ("lte", "5g-sa", "wifi", "handover", "satellite")
SEEDS = range(1, 51)
EXECUTORS = ("newest", "time-indexed", "ensemble", "async", "prefix", "rtc", "broker")
PREDICTORS = ("last_sample", "constant_velocity", "constant_acceleration", "kalman", "model_based")
"""What stands in place of an executor where a perception is ranked."""
CONSTANT, NONE = "constant", "no network"
"""Links of conditions beside those of `LINKS`."""
CONDITIONS: tuple[tuple[str, float | None], ...] = (
    (NONE, None),
    *((CONSTANT, each) for each in GRID),
    *((each, None) for each in LINKS),
)
"""Link and round trip [ms] of each condition, in the order of an entry."""


@dataclass(frozen=True)
class Shipped:
    """A policy of cloudrc, or one whose weights are in a package."""

    name: str  # of a file in `policies`, or of a perception
    executor: str = "newest"
    extras: tuple[str, ...] = ()


@dataclass(frozen=True)
class RankTask:
    """What a policy has to do."""

    about: str
    policies: tuple[Shipped, ...]
    env: str = ""  # id of gymnasium, or
    experiment: str = ""  # name of an experiment, in which a perception is ranked
    env_args: tuple[tuple[str, Any], ...] = ()
    success_at: float | None = None  # smallest return of a success [1]; None: as the info says
    max_steps: int = 10_000
    extras: tuple[str, ...] = ("gym",)
    is_usual: bool = True  # whether it is played without --task

    @property
    def executors(self) -> tuple[str, ...]:
        """What an entry may have one of."""
        return PREDICTORS if self.experiment else EXECUTORS

    @property
    def usual_executor(self) -> str:
        """That of a policy for which nobody names one."""
        return "constant_velocity" if self.experiment else "newest"


def _own(name: str) -> str:
    return f"cloudrc.studies.rank.environments:cloudrc/Rank{name}-v1"


def _arm(about: str, name: str) -> RankTask:
    """Return a task of Meta-World, whose environments take their seed as an argument."""
    given = (("env_name", name), ("seed", "{seed}"))
    experts = (Shipped("expert", extras=("arms",)),)
    arms = ("gym", "arms")
    return RankTask(about, experts, "metaworld:Meta-World/MT1", "", given, None, 300, arms)


_SEEN = (Shipped("gap", "constant_velocity"), Shipped("gap", "last_sample"))
TASKS = {
    "linear": RankTask(
        "keep an unstable plant (+ 5 % in 10 ms) near 0 for 20 s",
        (Shipped("linear"), Shipped("smith")),
        _own("Linear"),
    ),
    "cartpole": RankTask(
        "hold the pole of CartPole-v1 for 500 steps of 20 ms",
        (Shipped("pole"), Shipped("pole_chunk", "time-indexed")),
        "CartPole-v1",
        success_at=500.0,
    ),
    "pendulum": RankTask(
        "swing the pendulum of Pendulum-v1 up; it stands after 10 s",
        (Shipped("pendulum"),),
        _own("Pendulum"),
    ),
    "hover-motors": RankTask(
        "command the four motors of a drone of 27 g; after 8 s it is within 20 cm of its place",
        (Shipped("raptor", extras=("rank",)),),
        _own("Motors"),
        extras=("gym", *SIM),
    ),
    "hover-velocity": RankTask(
        "command the velocity of the drone of hover-motors, whose controller is on board, from the "
        "floor; after 8 s it is within 20 cm of its place, about 1 m above",
        (Shipped("velocity"),),
        _own("Velocities"),
        extras=("gym", *SIM),
    ),
    "reach-v3": _arm("reach for a point with the arm of Meta-World, within 300 steps", "reach-v3"),
    "push-v3": _arm(
        "push a puck to a point with the arm of Meta-World, within 300 steps", "push-v3"
    ),
    "door-open-v3": _arm(
        "open a door with the arm of Meta-World, within 300 steps", "door-open-v3"
    ),
    "gap": RankTask(
        "drive a rover along a corridor with pillars by its scans alone, to its end within "
        "40 s and without a touch",
        _SEEN,
        experiment="gap",
        extras=("gym", *SIM),
    ),
    "follow": RankTask(
        "keep a moving board in a drone's picture, with the perception `target`",
        (Shipped("target", "constant_velocity"),),
        experiment="follow",
        extras=("gym", *SIM, "camera"),
        is_usual=False,
    ),
}
PINNED = {
    "task linear": "45036f2ee3e2",
    "task cartpole": "2363ec874bc7",
    "task pendulum": "9e1e0c8b1ca7",
    "task hover-motors": "1765e11f315d",
    "task hover-velocity": "d920fc362750",
    "task reach-v3": "abbc1073c3a6",
    "task push-v3": "eb12c154e9e6",
    "task door-open-v3": "f9790997f597",
    "task gap": "9e6024647f7b",
    "task follow": "f158459fe9af",
    "link lte": "96c530405c8e",
    "link 5g-sa": "85381d0d605a",
    "link wifi": "310d93226dbe",
    "link handover": "73dfeb139453",
    "link satellite": "3d528ebe0364",
}
"""The hashes of this version; a test computes them."""


def hash_of_task(name: str) -> str:
    """Return the hash of all that a task pins; its experiment counts without comments."""
    task = asdict(TASKS[name]) | {"executors": TASKS[name].executors}
    del task["about"], task["policies"], task["extras"], task["is_usual"]
    # The module may move; the hash is of its name when this version was made.
    task["env"] = task["env"].replace("cloudrc.studies.rank.", "cloudrc.rank.")
    if task["experiment"]:
        task["experiment"] = _tree("experiment", task["experiment"])
    return _hash([task, CONDITIONS, [*SEEDS]])


@cache
def hash_of_link(name: str) -> str:
    """Return the hash of a shipped profile without its comments."""
    return _hash(_tree("profile", name))


def _tree(kind: str, name: str) -> Any:
    path = FOLDERS[kind] / f"{name}.yaml"
    tree = dict(read_document(path, path.name).tree)
    tree.pop("description", None)
    return tree


def _hash(content: Any) -> str:
    return sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:DIGITS]


def pinned(task: str) -> dict[str, str]:
    """Return the hashes that an entry for a task has: name -> hash."""
    names = (f"task {task}", *(f"link {each}" for each in LINKS))
    return {name: PINNED[name] for name in names}


@dataclass(frozen=True)
class Entrant:
    """A policy that plays a task."""

    task: str
    policy: str  # a name of ours, a file, or the address of a server
    executor: str
    extras: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Name of its file."""
        policy = Path(self.policy).stem if "://" not in self.policy else self.policy
        plain = "".join(each if each.isalnum() or each in "._" else "-" for each in policy)
        usual = self.executor == TASKS[self.task].usual_executor
        return f"{self.task}-{plain}" + ("" if usual else f"-{self.executor}")

    @property
    def command(self) -> str:
        """The line that plays it again."""
        words = ["--task", self.task, "--policy", self.policy, "--executor", self.executor]
        return shlex.join(["cloudrc", "rank", *words])

    @property
    def path(self) -> str:
        """The file of its policy; a server's address, or the name of a perception, stays."""
        own = Path(__file__).parent / "policies" / f"{self.policy}.py"
        shipped = self.policy in [each.name for each in TASKS[self.task].policies]
        return str(own) if shipped and TASKS[self.task].env else self.policy

    @property
    def lacking(self) -> list[str]:
        """The extras that it needs and that are not installed."""
        needed = dict.fromkeys((*TASKS[self.task].extras, *self.extras))
        return [each for each in needed if missing(each)]


def shipped(names: list[str]) -> Iterator[Entrant]:
    """Yield the policies that come with some tasks."""
    for name in names:
        for each in TASKS[name].policies:
            yield Entrant(name, each.name, each.executor, each.extras)
