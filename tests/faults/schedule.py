# SPDX-License-Identifier: Apache-2.0

"""Describe the faults of one flight and their times: chosen at random, or from a YAML file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import ConfigDict, Field, RootModel

from cloudrc.base.outside.document import read_document, write_yaml
from cloudrc.base.text import unknown_name_text
from cloudrc.config.problems import validate
from cloudrc.config.schema import World


def generator(seed: int, use: int) -> np.random.Generator:
    """Make a random generator from a seed; different `use` give independent sequences."""
    return np.random.Generator(np.random.PCG64([seed, use]))


KINDS = {
    "blackout": 8.0,  # no datagram passes
    "delay": 10.0,  # one-way delay rises by value [s]
    "jitter": 10.0,  # jitter rises to value [s]
    "loss": 10.0,  # a share of value is lost
    "bursts": 15.0,  # loss in bursts of value packets
    "corruption": 10.0,  # a share of value has 1 to 8 flipped bits
    "garbage": 5.0,  # value random datagrams arrive before every honest one
    "replay": 5.0,  # value captured datagrams arrive before every honest one
    "cloud_killed": 5.0,  # the cloud process is down
    "pod_killed": 8.0,  # the cloud pod with teleop is down
    "teleop_killed": 6.0,  # teleop is down
    "teleop_shut_down": 6.0,  # teleop pauses, and is down after a share of value
    "pod_shut_down": 8.0,  # teleop pauses, the pod is down after a share of value
    "cloud_paused": 5.0,  # the cloud process is stopped
    "cloud_throttled": 8.0,  # the cloud process gets a share of value of the CPU
    "world_paused": 1.0,  # the world process is stopped
    "world_killed": 3.0,  # the world process is down, then restarts
    "world_throttled": 8.0,  # the world process gets a share of value of the CPU
    "teleop_paused": 5.0,  # the teleop process is stopped
    "second_cloud": 15.0,  # another cloud with the same key joins
    "key_rotated": 10.0,  # world reads a new key, cloud reads it after the duration
    "key_wrong": 10.0,  # cloud has a wrong key
    "values_invalid": 10.0,  # value commands a second have NaN or infinity
    "values_huge": 10.0,  # value commands a second are 1e308 m/s
    "second_order": 0.0,  # another mission is ordered
    "stopped": 0.0,  # the operator stops the robot, and acknowledges later
    "held": 5.0,  # the operator holds the mission, resumes it after the duration
}
"""Name of a fault in a schedule's file -> longest random duration [s]; 0 for an instant."""
VALUES = {
    "delay": (0.01, 0.3),
    "jitter": (0.01, 0.15),
    "loss": (0.05, 0.9),
    "bursts": (3.0, 60.0),
    "corruption": (0.01, 1.0),
    "garbage": (1.0, 20.0),
    "replay": (1.0, 20.0),
    "teleop_shut_down": (0.0, 1.0),
    "pod_shut_down": (0.0, 1.0),
    "cloud_throttled": (0.05, 0.9),
    "world_throttled": (0.1, 0.95),
    "values_invalid": (1.0, 12.0),
    "values_huge": (1.0, 4.0),
}
"""Name of a fault -> smallest and largest random value, in the unit of the comment in `KINDS`."""
SHARES = ("loss", "corruption", "cloud_throttled", "world_throttled", "teleop_shut_down",
          "pod_shut_down")  # fmt: skip
"""Kinds of fault whose value is a share, in [0, 1]."""
DURATION_MAX = 86_400.0  # longest flight [s]
OFFSET_MAX = 1e6  # largest difference of the two clocks [s]
_CONFIG = ConfigDict(extra="forbid")
Time = Annotated[float, Field(ge=0.0, le=DURATION_MAX)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
Way = Literal["both", "up", "down"]
WAYS: tuple[Way, ...] = ("both", "up", "down")


@dataclass(frozen=True, slots=True)
class FaultEvent:
    """One fault, from `at` [s] for `duration` [s]; link faults hit one direction or both.

    The meaning and the unit of `value` depend on the kind of fault: see the comments of `KINDS`.
    """

    __pydantic_config__: ClassVar[ConfigDict] = _CONFIG
    kind: str
    at: Time
    duration: Time = 0.0
    value: Annotated[float, Field(ge=0.0, le=1e9)] = 0.0
    way: Way = "both"

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(unknown_name_text("fault", self.kind, [*KINDS]))
        if self.kind in SHARES and self.value > 1.0:
            raise ValueError(f"the value {self.value:g} is not between 0 and 1")

    @property
    def end(self) -> float:
        """Time at which the fault ends [s, virtual time]."""
        return self.at + self.duration


@dataclass(frozen=True, slots=True)
class Schedule:
    """All faults of one flight; `seed` determines the random numbers of link and faults."""

    __pydantic_config__: ClassVar[ConfigDict] = _CONFIG
    seed: Annotated[int, Field(ge=0, le=2**63)]
    profile: str = "paper-p2"
    events: tuple[FaultEvent, ...] = ()
    duplicate: Share = 0.0  # share of datagrams that arrive twice
    reorder: Share = 0.0  # share of datagrams that overtake others
    cloud_offset: Annotated[float, Field(ge=-OFFSET_MAX, le=OFFSET_MAX)] = 0.0
    """Cloud's clock minus world's clock [s], plus `OFFSET_MAX` if negative; 0 if they share one."""
    cloud_drift: Annotated[int, Field(ge=-100_000, le=100_000)] = 0  # drift of cloud's clock [ppm]
    policy: str = ""  # policy of a dishonest cloud; "" for an honest cloud
    duration: Annotated[float, Field(ge=0.1, le=DURATION_MAX)] = 60.0  # [s]
    hold_max: Annotated[float, Field(ge=0.1, le=3600.0)] = 60.0  # HOLD becomes LAND then [s]
    robot: str = World().robot  # name of a shipped robot, or a path

    @property
    def quiet_from(self) -> float:
        """Time at which the last fault ends [s, virtual time]; 0 without faults."""
        return max((event.end for event in self.events), default=0.0)

    def of(self, *kinds: str) -> list[FaultEvent]:
        """List the faults of these kinds in the order of time."""
        return sorted((e for e in self.events if e.kind in kinds), key=lambda e: e.at)


_File = RootModel[Schedule]


def dump(schedule: Schedule, note: str = "") -> str:
    """Format a schedule as YAML, with `note` as a comment at the top."""
    document = _File(schedule).model_dump(mode="json", exclude_defaults=True)
    head = "".join(f"# {line}\n" for line in note.splitlines())
    return head + write_yaml(document)


def load(path: Path) -> Schedule:
    """Read a schedule from a file; raise a BadInputError if it is no valid schedule."""
    schedule = validate(read_document(path, str(path)), _File, str(path)).root
    for each in schedule.events:
        if each.at >= schedule.duration:
            late = f"the fault {each.kind} at {each.at:g} s never begins"
            raise ValueError(f"{late}: duration is {schedule.duration:g} s")
    return schedule


CALM = 45.0  # time after which there are no faults and the robot must recover [s]
DURATION = 60.0  # duration of a flight [s]
PROFILES = ("ideal", "wifi", "lte", "5g", "lossy", "paper-p1", "paper-p2", "paper-p3")
PAPER = PROFILES[-3:]
HOLDS = 0.8, 3.0  # range of a random `hold_max` [s]; to end a HOLD takes 0.75 s
ONCE = ("second_cloud", "key_rotated")  # kinds of fault that a flight has at most once


def compose(seed: int) -> Schedule:
    """Return the schedule for a seed: up to 12 faults in 45 s, then 15 s without faults.

    A schedule without faults uses one of the paper's link profiles, with which the guard should
    never enter HOLD.
    """
    rng, kinds, events = generator(seed, 40), sorted(KINDS), list[FaultEvent]()
    for _ in range(int(rng.integers(13))):
        kind = kinds[int(rng.integers(len(kinds)))]
        if kind not in ONCE or all(event.kind != kind for event in events):
            events.append(_event(kind, rng))
    if not events:
        return Schedule(seed, PAPER[seed % len(PAPER)], duration=DURATION)
    return Schedule(
        seed,
        PROFILES[int(rng.integers(len(PROFILES)))],
        tuple(sorted(events, key=lambda event: event.at)),
        duplicate=_sometimes(rng, 1.0),
        reorder=_sometimes(rng, 0.5),
        cloud_offset=round(rng.uniform(-1e5, 1e5), 3) if rng.random() < 0.5 else 0.0,
        cloud_drift=int(rng.integers(-500, 501)) if rng.random() < 0.3 else 0,
        duration=DURATION,
        # In a third of the schedules it is shorter than most silences, so the robot lands.
        hold_max=round(rng.uniform(*HOLDS), 1) if rng.random() < 1 / 3 else 60.0,
    )


def _event(kind: str, rng: np.random.Generator) -> FaultEvent:
    longest, (low, high) = KINDS[kind], VALUES.get(kind, (0.0, 0.0))
    at, way = rng.uniform(0.5, CALM - 1.0), WAYS[int(rng.integers(3))]
    duration = 0.0
    if longest:  # short ones are as likely as long ones: 20 ms find as much as 5 s
        duration = min(max(longest * rng.uniform() ** 3, 0.02), CALM - at)
    value = rng.uniform(low, high)
    return FaultEvent(kind, round(at, 3), round(duration, 3), round(value, 4), way)


def _sometimes(rng: np.random.Generator, most: float) -> float:
    return round(rng.uniform(0.0, most), 3) if rng.random() < 0.25 else 0.0
