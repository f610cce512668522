# SPDX-License-Identifier: Apache-2.0

"""Faults that an experiment injects: their keys, and what they do to the link's time line."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Annotated, Literal

from pydantic import Field, model_validator

from cloudrc.config.profile import BlackoutConfig, BurstsConfig, ChangeConfig, DirectionConfig
from cloudrc.config.section import Section, leave_out_empty
from cloudrc.link.profile import NotNegative, Positive

PARTITION, BURST, RAMP = "partition", "burst", "ramp"
NEEDS = {PARTITION: (), BURST: ("packets",), RAMP: ("delay_ms",)}
"""Kind of fault -> the keys that it has besides those of all kinds."""
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

    kind: Literal["partition", "burst", "ramp"]
    """What happens. partition: every packet is lost; burst: one packet in a hundred begins a burst
    of losses; ramp: the delay rises, then falls back at once"""
    at_s: NotNegative
    """Start, in time since the link came up [s]"""
    duration_s: Positive
    """Length [s]"""
    direction: Literal["both", "uplink", "downlink"] = "both"
    """Direction of the link"""
    packets: Annotated[float, Field(ge=1)] | None = None
    """Mean length of the bursts of a burst [packets]"""
    delay_ms: Positive | None = None
    """By how much the one-way delay has risen at the end of a ramp [ms]"""

    _write = leave_out_empty("packets", "delay_ms")

    @model_validator(mode="after")
    def _check_keys(self) -> FaultConfig:
        for key in ("packets", "delay_ms"):
            needed, given = key in NEEDS[self.kind], getattr(self, key) is not None
            if needed and not given:
                raise ValueError(f"{self.kind} needs {key}")
            if given and not needed:
                raise ValueError(f"{self.kind} has no {key}")
        return self

    @property
    def end(self) -> float:
        """Time at which the fault ends [s]."""
        return self.at_s + self.duration_s


def refusal(faults: Sequence[FaultConfig], *ways: DirectionConfig, goes_round: bool) -> str:
    """Say why the time lines of a link cannot have these faults; "" if they can."""
    if faults and (goes_round or any(way.loop for way in ways)):
        return "faults: the time line of the link goes round; leave out loop, or start_s: random"
    if any(fault.kind != PARTITION for fault in faults) and any(way.trace for way in ways):
        return (
            "faults: a trace gives the delays and losses of the link; only a partition is possible"
        )
    return ""


def with_faults(
    way: DirectionConfig, faults: Iterable[FaultConfig], start: float
) -> DirectionConfig:
    """Write faults of a direction into its time line, in which the flight begins at `start` [s]."""
    moved = [fault.model_copy(update={"at_s": fault.at_s + start}) for fault in faults]
    cuts = [
        BlackoutConfig.model_validate({"start_s": fault.at_s, "duration_s": fault.duration_s})
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
        steps = range(int(wave.duration_s / RAMP_STEP)) if wave.kind == RAMP else range(1)
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
            share = min((instant - wave.at_s + RAMP_STEP) / wave.duration_s, 1.0)
            now["delay_ms"] = round(now["delay_ms"] + wave.delay_ms * share, 6)
    return ChangeConfig.model_validate({"at_s": instant, **now})
