"""What an evaluation plays: an environment, a policy, and the conditions of the network."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from hashlib import sha256
from math import nan
from pathlib import Path
from statistics import fmean
from typing import Any, TypeAlias

from cloudrc.errors import BadInputError
from cloudrc.gym.step import StepTime
from cloudrc.link.doubts import describe_heavy_loss
from cloudrc.link.library import LinkProfile, read_profile
from cloudrc.link.profile import DirectionProfile
from cloudrc.link.traces import read_lines
from cloudrc.outside.code import sources
from cloudrc.outside.document import parse_value, read_document
from cloudrc.outside.reuse import reuse
from cloudrc.outside.values import ANY
from cloudrc.plugins import is_path
from cloudrc.policy.address import check_url
from cloudrc.policy.observation import Mapped
from cloudrc.runs.installed import plugin_code
from cloudrc.runs.own_files import hash_of

Compute: TypeAlias = float | tuple[float, float] | tuple[str, str]
"""Time for an answer [s]: constant; or mean and deviation; or (FILE, name) or (MEASURED, "")."""
FILE, MEASURED = "file", "measured"
SEED = "{seed}"
"""Value of an environment's argument that stands for the seed of the episode."""
BASELINE = "no network"
"""Executor of the episodes without a network: the policy answers each observation in its step."""
BARE: dict[str, Any] = {"link": "ideal", "compute": 0.0, "observation_bytes": None}
"""What these episodes have in place of the values of the setup."""
COMPUTE_MAX = 3600.0
"""Largest time for an answer [s]."""


@dataclass(frozen=True)
class EvalSetup:
    """An evaluation without its conditions; all fields are plain values, for worker processes."""

    env: str  # id of gymnasium
    policy: str  # path of a file, or address of a server
    env_args: tuple[tuple[str, Any], ...] = ()
    link: str = "ideal"  # profile, by name or path
    compute: Compute = 0.0
    mapped: tuple[Mapped, ...] = ()  # how an observation becomes the policy's; (): as it is
    success_at: float | None = None  # smallest return of a success [1]; None: what the info says
    dt: float | None = None  # time of a step [s]; None: that of the environment
    max_steps: int = 10_000  # longest episode
    observation_bytes: int | None = None  # of an observation on the wire; None: that of its arrays
    answer_within: float | None = None  # how long the robot waits in a step [s]; None: 5 % of it
    follows_seed: bool = True  # whether equal seeds give equal episodes
    env_code: str = ""  # hash of the environment's code and files
    deadline: float | None = None  # an action of an older observation is late [s]
    step: StepTime | None = None  # of the environment, and who tells its time

    @property
    def is_remote(self) -> bool:
        """Whether a server computes the actions."""
        return "://" in self.policy

    @property
    def is_repeatable(self) -> bool:
        """Whether the environment follows its seed, and no clock of this machine counts."""
        return self.follows_seed and not self.is_measured

    @property
    def is_measured(self) -> bool:
        """Whether the time for an answer is measured."""
        return isinstance(self.compute, tuple) and self.compute[0] == MEASURED

    def identity(self) -> dict[str, Any]:
        """Return all that the result of an episode depends on, but its condition and seed."""
        told = asdict(self)
        if not self.is_remote:
            told["policy"] = hash_of(sources(Path(self.policy)))
        told["link"] = _code_of_link(read_profile(self.link))
        if isinstance(self.compute, tuple) and self.compute[0] == FILE:
            told["compute"] = hash_of([Path(str(self.compute[1]))])
        return told


@dataclass(frozen=True)
class Episode:
    """One episode: a condition, and the seed of environment and network."""

    rtt_ms: float | None  # mean round trip [ms]; None: that of the profile
    executor: str
    seed: int

    @property
    def point(self) -> dict[str, Any]:
        """The condition without its seed."""
        return {"rtt_ms": self.rtt_ms, "executor": self.executor}

    @property
    def is_baseline(self) -> bool:
        """Whether the episode has no network."""
        return self.executor == BASELINE

    def key(self, identity: Mapping[str, Any]) -> str:
        """Return the name of the row: equal keys mean equal episodes."""
        if self.is_baseline:
            identity = {**identity, **BARE}
        own = reuse(("executor", self.executor), self._executor_code)
        text = json.dumps([identity, self.point, own, self.seed], sort_keys=True, default=str)
        return sha256(text.encode()).hexdigest()[:16]

    def _executor_code(self) -> str:
        if is_path(self.executor):
            return hash_of(sources(Path(self.executor)))
        return plugin_code("executors", "newest" if self.is_baseline else self.executor)


def _code_of_link(link: LinkProfile) -> str:
    """Return the hash of a profile with the contents of its files, wherever they are."""
    ways = [replace(way, trace=None, table=None) for way in (link.uplink, link.downlink)]
    return sha256(repr(ways).encode()).hexdigest()


def check_setup(setup: EvalSetup) -> None:
    """Raise a BadInputError if policy or compute file cannot be used."""
    if setup.is_remote:
        try:
            check_url(setup.policy)
        except ValueError as error:
            raise BadInputError(f"--policy: {error}") from None
    elif not is_path(setup.policy) or not Path(setup.policy).is_file():
        raise BadInputError(
            f"--policy {setup.policy}: there is no such file; give a Python file, such as "
            "./expert.py, or the address of a server, such as ws://127.0.0.1:8000"
        )
    if isinstance(setup.compute, tuple) and setup.compute[0] == FILE:
        read_times(str(setup.compute[1]))


def link_at(profile: str, rtt_ms: float | None) -> LinkProfile:
    """Return a link profile with the mean round trip `rtt_ms` [ms]; None: as it is.

    The two delays keep the ratio of the profile. Jitter, loss and rate stay, but no jitter is
    larger than its delay, which would raise the mean.
    """
    link = read_profile(profile)
    if rtt_ms is None:
        return link
    both = link.uplink, link.downlink
    if any(way.rows or way.changes for way in both):
        raise BadInputError(
            f"--rtt: the delays of the profile '{profile}' change over time; leave --rtt out, or "
            "choose a profile with constant delays"
        )
    whole = sum(way.delay_ms for way in both)
    share = link.uplink.delay_ms / whole if whole else 0.5

    def at(way: DirectionProfile, delay: float) -> DirectionProfile:
        return replace(way, delay_ms=delay, jitter_ms=min(way.jitter_ms, delay))

    return LinkProfile(at(link.uplink, share * rtt_ms), at(link.downlink, (1 - share) * rtt_ms))


def read_compute(text: str) -> Compute:
    """Read the time for an answer: a number [s], "MEAN,DEVIATION" [s], "measured", or a file."""
    if text == MEASURED:
        return MEASURED, ""
    try:
        numbers = [ANY.read(each) for each in text.split(",")]
    except ValueError:
        if os.path.lexists(text):
            return FILE, text
        numbers = []
    if len(numbers) not in (1, 2) or not all(0.0 <= each <= COMPUTE_MAX for each in numbers):
        raise BadInputError(
            f"--compute {text}: give the time for an answer: a number of s such as 0.05, "
            f"MEAN,DEVIATION in s, the path of a file that exists, or '{MEASURED}'"
        )
    return numbers[0] if len(numbers) == 1 else (numbers[0], numbers[1])


def mean_compute(compute: Compute) -> float:
    """Return the mean time for an answer [s]; 0 if it is measured."""
    if isinstance(compute, float):
        return compute
    kind, value = compute
    if kind == FILE:
        return fmean(read_times(str(value)))
    return 0.0 if kind == MEASURED else float(kind)


def heavy_loss(setup: EvalSetup) -> Iterator[str]:
    """Warn of a loss of the link of which 100 times less may be meant."""
    link = read_profile(setup.link)
    yield from describe_heavy_loss(link.uplink, "uplink")
    yield from describe_heavy_loss(link.downlink, "downlink")


def read_times(path: str) -> tuple[float, ...]:
    """Read the times of a file [s]: the last column of a CSV file; a head is skipped."""
    what, found = f"--compute {path}", list[float]()
    lines = read_lines(Path(path), what, "give a text file with one time in seconds per line")
    rows = [(number, line) for number, line in enumerate(lines, start=1) if line.strip()]
    for number, line in rows:
        text = line.rpartition(",")[2].strip(' \t"')
        try:
            time = ANY.read(text)
        except ValueError:
            if number == rows[0][0] and not text.lstrip("+-.")[:1].isdigit():
                continue  # the head
            time = nan
        if not 0.0 <= time <= COMPUTE_MAX:
            raise BadInputError(f"{what}, line {number}: {text[:40]!r} is no time in seconds")
        found.append(time)
    if not found:
        raise BadInputError(f"{what}: has no times")
    return tuple(found)


def read_env_args(texts: list[str]) -> tuple[tuple[str, Any], ...]:
    """Read arguments of an environment, given as KEY=VALUE; a value is YAML, also with None."""
    found = dict[str, Any]()
    for text in texts:
        key, equals, value = text.partition("=")
        if not (equals and key.isidentifier()):
            raise BadInputError(f"--env-arg {text}: give KEY=VALUE, such as env_name=reach-v3")
        if value == "None" or value.startswith(("[", "{")):
            value = re.sub(r"(?<!['\"\w])None(?!['\"\w])", "null", value)
        found[key] = value if value == SEED else parse_value(value, f"--env-arg {key}")
    return tuple(sorted(found.items()))


def read_mapped(path: Path | None) -> tuple[Mapped, ...]:
    """Read the map from an environment's observation to that of a policy; () without a file."""
    if path is None:
        return ()
    found, example = list[Mapped](), "observation/state: agent_pos, or prompt: {value: go}"
    for key, value in read_document(path, path.name).tree.items():
        if isinstance(value, str) and value:
            found.append(Mapped(str(key), value))
        elif isinstance(value, Mapping) and value.keys() == {"value"}:
            found.append(Mapped(str(key), None, value["value"]))
        else:
            raise BadInputError(
                f"{path}: {key}: give the place in the environment's observation, or a value; for "
                f"example {example}"
            )
    if not found:
        raise BadInputError(f"{path}: has no keys; for example {example}")
    return tuple(found)
