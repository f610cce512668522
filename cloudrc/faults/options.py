"""How a flight of the fault suite may differ from the plain one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias, TypedDict

from cloudrc.cloud.endpoint import CloudEndpoint
from cloudrc.faults.mortal import Clock
from cloudrc.link.profile import Blackout, DirectionProfile
from cloudrc.tunnel.keys import Key, KeySet

Shape: TypeAlias = Callable[[DirectionProfile], DirectionProfile]
"""Changes the conditions of one direction of the link."""
SECRET = KeySet(Key(b"a key of the fault suite, 32 b.."))


class Options(TypedDict, total=False):
    """How a flight differs from the plain one.

    Attributes:
        seed: Of everything random; 1 by default.
        cloud_clock: Cloud's; by default the two ends share a clock.
        uplink: Changes the link's conditions from world to cloud.
        downlink: Likewise from cloud to world.
        honest: Whether a contact is the cloud's failure; it is by default.
        keep: Whether all records are kept and hashed; they are by default.
        start: Whether the experiment's mission is ordered; it is by default.
        life: Tells the processes of one flight from those of another, as nonces do.
        tempt: Makes a new cloud, which has valid keys, another one than it was.
        secrets: Key files by end; the same one for both by default.
        second: When another cloud wants the robot, too [s]; never by default.
        journal: Of teleop; in memory by default.
        apart: Whether teleop is a process of its own; it is in cloud's by default.
    """

    seed: int
    cloud_clock: Clock | None
    uplink: Shape | None
    downlink: Shape | None
    honest: bool
    keep: bool
    start: bool
    life: int
    tempt: Callable[[CloudEndpoint], None] | None
    secrets: dict[str, KeySet]
    second: float | None
    journal: Path
    apart: bool


def blackouts(*spans: tuple[float, float]) -> Shape:
    """Let nothing pass: each span is its start and its duration [s]."""
    return lambda profile: replace(
        profile, blackouts=(*profile.blackouts, *(Blackout(*span) for span in spans))
    )
