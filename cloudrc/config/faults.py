# SPDX-License-Identifier: Apache-2.0

"""Faults that an experiment injects: their keys, and what they do to the link's schedule.

`faults.py` in `flight/virtual/` and in `flight/local/` injects those of processes and clocks.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import Annotated, Literal

from pydantic import Field, model_validator

from cloudrc.config.profile import BlackoutConfig, BurstsConfig, ChangeConfig, DirectionConfig
from cloudrc.config.section import Section, leave_out_unset
from cloudrc.link.profile import NotNegative, Positive

PARTITION, BURST, RAMP = "partition", "burst", "ramp"
CLOUD_KILLED, CLOUD_PAUSED = "cloud_killed", "cloud_paused"
TELEOP_KILLED, WORLD_PAUSED = "teleop_killed", "world_paused"
CLOCK_STEP, CLOCK_DRIFT = "clock_step", "clock_drift"
NEEDS = {
    PARTITION: ("duration_s",),
    BURST: ("duration_s", "packets"),
    RAMP: ("duration_s", "delay_ms"),
    CLOUD_KILLED: ("duration_s",),
    CLOUD_PAUSED: ("duration_s",),
    TELEOP_KILLED: ("duration_s",),
    WORLD_PAUSED: ("duration_s",),
    CLOCK_STEP: ("step_s",),
    CLOCK_DRIFT: ("duration_s", "drift_ppm"),
}
"""Kind of fault -> the keys that it has besides `kind` and `at_s`."""
OF_LINK = (PARTITION, BURST, RAMP)
"""Kinds of faults of the link; they may be in one direction."""
OF_CLOCK = (CLOCK_STEP, CLOCK_DRIFT)
"""Kinds of faults of cloud's clock."""
KEYS = ("duration_s", "packets", "delay_ms", "step_s", "drift_ppm")
"""Keys that not every kind has."""
BURST_STARTS = 0.01
"""Chance that a burst of losses begins with a packet."""
NOT_IN_CLUSTER = (
    "a cluster does not inject them; in flight, end a pod: "
    "kubectl delete pod -l app.kubernetes.io/component=cloud, or change the link: cloudrc link set"
)
RAMP_STEP = 0.1
"""Time between two changes of the delay in a ramp [s]."""


class FaultConfig(Section):
    """A fault that is injected in flight."""

    kind: Literal[
        "partition",
        "burst",
        "ramp",
        "cloud_killed",
        "cloud_paused",
        "teleop_killed",
        "world_paused",
        "clock_step",
        "clock_drift",
    ]
    """What happens. partition: every packet is lost; burst: one packet in a hundred begins a burst
    of losses; ramp: the delay rises, then falls back at once; cloud_killed, teleop_killed: the
    process is killed, and a new one starts at the end; cloud_paused, world_paused: the process
    stands still; clock_step: cloud's clock jumps ahead; clock_drift: cloud's clock runs faster"""
    at_s: NotNegative
    """Start, in time since the link came up [s]"""
    duration_s: Positive | None = None
    """Length; only a clock_step has none [s]"""
    direction: Literal["uplink", "downlink"] | None = None
    """Direction of the link; null: both"""
    packets: Annotated[float, Field(ge=1)] | None = None
    """Mean length of the bursts of a burst [packets]"""
    delay_ms: Positive | None = None
    """By how much the one-way delay has risen at the end of a ramp [ms]"""
    step_s: Annotated[float, Field(gt=0, le=1_000_000)] | None = None
    """By how much cloud's clock jumps ahead; a monotonic clock never goes back [s]"""
    drift_ppm: Annotated[int, Field(ge=-1000, le=1000)] | None = None
    """By how much cloud's clock is faster than before [ppm]"""

    _write = leave_out_unset("direction", *KEYS)

    @model_validator(mode="after")
    def _check_keys(self) -> FaultConfig:
        for key in KEYS:
            needed, given = key in NEEDS[self.kind], getattr(self, key) is not None
            if needed and not given:
                raise ValueError(f"{self.kind} needs {key}")
            if given and not needed:
                raise ValueError(f"{self.kind} has no {key}")
        if self.direction and self.kind not in OF_LINK:
            raise ValueError(f"{self.kind} has no direction")
        return self

    @property
    def length(self) -> float:
        """Time for which the fault lasts [s]."""
        return self.duration_s or 0.0

    @property
    def end(self) -> float:
        """Time at which the fault ends [s]."""
        return self.at_s + self.length


def acting(faults: Iterable[FaultConfig], *kinds: str) -> list[FaultConfig]:
    """Return the faults of these kinds, the earliest first."""
    return sorted((each for each in faults if each.kind in kinds), key=lambda each: each.at_s)


def refusal(
    faults: Sequence[FaultConfig], *ways: DirectionConfig, goes_round: bool, is_fleet: bool
) -> str:
    """Say why a flight over a link with these schedules cannot have the faults; "" if it can."""
    link = acting(faults, *OF_LINK)
    if link and (goes_round or any(way.loop for way in ways)):
        return "faults: the schedule of the link repeats; leave out loop, or start_s: random"
    if any(fault.kind != PARTITION for fault in link) and any(way.trace for way in ways):
        return (
            "faults: a trace gives the delays and losses of the link; only a partition is possible"
        )
    if is_fleet and len(link) < len(faults):
        return "faults: a fleet can only have those of the link; fly a robot alone by fleet.only"
    for process in ("cloud", "teleop", "world"):
        mine = acting(faults, f"{process}_killed", f"{process}_paused")
        if any(after.at_s <= before.end for before, after in pairwise(mine)):
            return f"faults: two of {process} overlap; let the second one begin later"
    return ""


def refusal_in(mode: str, faults: Sequence[FaultConfig]) -> str:
    """Say why a mode ("virtual", "local" or "cluster") cannot inject these faults; "" if it can."""
    if mode == "cluster" and faults:
        return NOT_IN_CLUSTER
    if mode == "local" and (clocks := acting(faults, *OF_CLOCK)):
        return f"{clocks[0].kind} acts in virtual time only; use --mode virtual, or leave it out"
    if mode == "local" and len(acting(faults, CLOUD_KILLED)) > 1:
        return "in real time, cloud_killed is possible once; use --mode virtual, or leave one out"
    return ""


def with_faults(
    way: DirectionConfig, faults: Iterable[FaultConfig], start: float
) -> DirectionConfig:
    """Write faults of a direction into its schedule, in which the flight begins at `start` [s]."""
    moved = [fault.model_copy(update={"at_s": fault.at_s + start}) for fault in faults]
    cuts = [
        BlackoutConfig.model_validate({"start_s": fault.at_s, "duration_s": fault.length})
        for fault in moved
        if fault.kind == PARTITION
    ]
    waves = [fault for fault in moved if fault.kind != PARTITION]
    changes = _changes(way, waves) if waves else way.changes
    return way.model_copy(update={"blackouts": (*way.blackouts, *cuts), "changes": changes})


def _changes(way: DirectionConfig, waves: list[FaultConfig]) -> tuple[ChangeConfig, ...]:
    """Return the changes of a direction in which each of `waves` acts while it lasts."""
    instants = {change.at_s for change in way.changes}
    for wave in waves:
        steps = range(int(wave.length / RAMP_STEP)) if wave.kind == RAMP else range(1)
        instants |= {round(wave.at_s + n * RAMP_STEP, 6) for n in steps} | {wave.at_s, wave.end}
    return tuple(_change(way, waves, instant) for instant in sorted(instants))


def _change(way: DirectionConfig, waves: list[FaultConfig], instant: float) -> ChangeConfig:
    """Return the conditions of a direction from `instant` [s] on."""
    keys = "delay_ms", "jitter_ms", "loss", "rate_kbit"
    now = {key: getattr(way, key) for key in keys}
    for change in way.changes:
        if change.at_s <= instant:
            given = {key: getattr(change, key) for key in keys}
            now |= {key: value for key, value in given.items() if value is not None}
    for wave in waves:
        if not wave.at_s <= instant < wave.end:
            continue
        if wave.packets is not None:
            bursts = {"bad_start": BURST_STARTS, "bad_end": 1.0 / wave.packets}
            now["loss"] = BurstsConfig.model_validate(bursts)
        if wave.delay_ms is not None:
            share = min((instant - wave.at_s + RAMP_STEP) / wave.length, 1.0)
            now["delay_ms"] = round(now["delay_ms"] + wave.delay_ms * share, 6)
    return ChangeConfig.model_validate({"at_s": instant, **now})
