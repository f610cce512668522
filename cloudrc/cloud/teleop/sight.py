"""The robot as teleop sees it: telemetry comes in; its state, since when and what is next go out.

What comes next follows from state and mission.
"""

from __future__ import annotations

from math import isfinite
from typing import Any

from cloudrc.cloud.teleop.messages import Seen
from cloudrc.messages import GuardState

GROUND, TRACK, HOLD, LAND, ESTOP = GuardState
LATCHED = (LAND, ESTOP)
"""States of the guard that only the operator's acknowledgement leads out of."""
SILENCE = 1.0
"""Telemetry that is older tells no more how the robot is, nor a word of cloud that it lives [s]."""
REST = "after a stop or a touch-down only once it has been still, 0.5 m inside the fence"
BY_ITSELF = "without commands the robot holds where it flies, then lands, by itself"
NOT_HEARD = f"the robot is not heard, though cloud is: look at the link and at world; {BY_ITSELF}"
NO_CLOUD = f"cloud is not heard, and so the robot is not: look at cloud's process; {BY_ITSELF}"
ALONE = {
    GROUND: f"the robot waits for a mission; it takes off, {REST}",
    TRACK: "the robot is being told that its mission is over, and holds then",
    HOLD: "the robot holds and waits for a mission",
    LAND: "the robot lands; see why, then: cloudrc mission acknowledge",
    ESTOP: "the rotors are stopped; see why, then: cloudrc mission acknowledge",
}
"""What comes next while no mission is under way, by the guard's state."""
IN_MISSION = {
    **ALONE,
    GROUND: f"the robot takes off with the mission's first commands, {REST}; without them for long "
    "(guard.hold_max_s, 10 s at least) it is in LAND as it stands",
    TRACK: "the robot flies its mission",
    HOLD: "no fresh commands reach the robot: it goes on by itself as soon as they do, and lands "
    "if they do not for long (guard.hold_max_s)",
}
HELD = "the operator holds the mission; to go on: cloudrc mission resume"


class Sight:
    """The newest telemetry.

    Attributes:
        seen: What it says; None until the robot has been seen.
    """

    def __init__(self) -> None:
        self.seen: Seen | None = None
        self._seen_ns = self._guard_ns = 0
        self._heard_ns: int | None = None

    @property
    def guard(self) -> GuardState:
        """State of the guard; GROUND until it has been seen."""
        return GROUND if self.seen is None else self.seen.guard

    @property
    def latched(self) -> str:
        """Why the guard lets nothing fly before it is acknowledged; "" if it does."""
        guard = self.guard
        if self.seen is None or guard not in LATCHED:
            return ""
        return f"the guard is in {guard.name} ({self.seen.cause.words}) and lets nothing fly"

    def hear(self, now_ns: int) -> None:
        """Take note that cloud lives, whether it has telemetry or not [ns]."""
        self._heard_ns = now_ns

    def cloud_age(self, now_ns: int) -> float | None:
        """Say how long cloud has not been heard [s]; None if it never was.

        Args:
            now_ns: Own clock [ns].
        """
        return None if self._heard_ns is None else (now_ns - self._heard_ns) * 1e-9

    def see(self, seen: Seen, now_ns: int) -> bool:
        """Take note of telemetry as it arrives [ns].

        Returns:
            Whether the same robot is seen in another session than before.
        """
        before, self.seen, self._seen_ns = self.seen, seen, now_ns
        self.hear(now_ns)
        if before is None or before.world != seen.world:
            self._guard_ns = now_ns
            return False
        if before.guard is not seen.guard:
            self._guard_ns = now_ns
        return before.epoch != seen.epoch

    def show(self, now_ns: int, mission: str | None) -> dict[str, Any] | None:
        """Say how the robot is, as the API shows it; None if it has not been seen.

        Args:
            now_ns: Own clock [ns].
            mission: State of the one under way, in a word; None if there is none.
        """
        seen, age, cloud_age = self.seen, (now_ns - self._seen_ns) * 1e-9, self.cloud_age(now_ns)
        if seen is None or cloud_age is None:
            return None
        return {
            "age_s": age,
            "epoch": seen.epoch,
            "world": seen.world,
            "position_m": [_known(value) for value in seen.position],
            "guard": seen.guard.name,
            "cause": seen.cause.words,
            "guard_for_s": (now_ns - self._guard_ns) * 1e-9 if age <= SILENCE else None,
            "next_step": next_step(seen.guard, age, cloud_age, mission),
            "pipe_contacts": seen.pipe_contacts,
            "touch_speed_mps": _known(seen.touch_speed),
            "horizon_s": _known(seen.horizon),
            "rtt_s": _known(seen.rtt),
            "loop_delay_s": _known(seen.loop_delay),
        }


def next_step(guard: GuardState, age: float, cloud_age: float, mission: str | None) -> str:
    """Say what comes next, or what the operator has to do for it.

    Args:
        guard: State of the guard.
        age: Of the telemetry that says so [s].
        cloud_age: How long cloud has not been heard [s], which tells of telemetry.
        mission: State of the one under way, in a word; None if there is none.
    """
    if age > SILENCE:
        return NO_CLOUD if cloud_age > SILENCE else NOT_HEARD
    if mission == "held" and guard is TRACK:
        return HELD
    return (ALONE if mission is None else IN_MISSION)[guard]


def _known(value: float) -> float | None:
    """JSON knows no NaN."""
    return value if isfinite(value) else None
