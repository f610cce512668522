"""What a mission bears: verbs that do not fit its state are refused, harm that is seen ends it."""

from __future__ import annotations

from cloudrc.cloud.teleop.messages import (
    Acknowledge,
    Cancel,
    Continue,
    GoTo,
    Hold,
    Pause,
    Resume,
    Seen,
    StartMission,
    State,
    Verb,
)
from cloudrc.errors import BadInputError
from cloudrc.geometry import fence
from cloudrc.messages import GuardState, Setpoint

WORST_GUARD = GuardState.HOLD
ANY_WORLD = ""
"""Until the robot is seen to have started it does not matter which world it stands in."""
HELD_LOWEST = fence.LOW[2] + fence.FLOOR_MARGIN
"""No robot is held lower [m]: it would scrape along the floor. One that has not taken off yet does,
and is held there. Source: docs/safety.md, "The guard"."""
NO_WAYPOINT = -1
UNDER_WAY = (State.FLYING, State.STARTING, State.HELD)
ENDS = {"done": State.DONE, "cancelled": State.CANCELLED}
"""By their codes; every other one is a failure."""
END_LOST = "end_lost", "the robot knows it to be over, how it ended was not kept;"
RESTS = tuple(state for state in State if state not in UNDER_WAY)

_RULES: dict[type[Verb], tuple[str, tuple[State, ...], str]] = {
    StartMission: ("start", RESTS, "cancel it first"),
    Continue: ("continue", (State.IDLE,), "it is not the first"),
    Hold: ("hold", (State.FLYING,), "it has to be flying"),
    Resume: ("resume", (State.HELD,), "it has to be held"),
    Cancel: ("cancel", UNDER_WAY, "there is none under way"),
    GoTo: ("goto", (State.HELD, *RESTS), "hold or cancel it first"),
    Acknowledge: ("acknowledge", RESTS, "it flies"),
    Pause: ("pause", UNDER_WAY, "there is none under way"),
}
"""Of each verb: its name, the states that allow it, and what is wrong with the others; an
emergency stop is allowed in every state."""


def refuse_unless_fitting(verb: Verb, state: State) -> None:
    """Let a verb pass that fits the state of the mission.

    Raises:
        BadInputError: If it does not.
    """
    name, allowed, why = _RULES.get(type(verb), ("", (state,), ""))
    if state not in allowed:
        raise BadInputError(f"{name}: the mission is {state.name}; {why}")


def held_at(seen: Seen, before: Setpoint | None) -> Setpoint:
    """Where a robot is held that is seen there; it looks as it was told before."""
    x, y, z = seen.position
    yaw = 0.0 if before is None else before.yaw
    return Setpoint((x, y, max(z, HELD_LOWEST)), yaw, NO_WAYPOINT)


def known_on_board(seen: Seen, mission_id: int) -> int:
    """How many waypoints of a mission the robot knows to be reached."""
    return seen.reached if seen.mission_id == mission_id != 0 else 0


def is_over(seen: Seen, mission_id: int, over: int) -> bool:
    """Whether the robot knows a mission to be over; `over` waypoints reached mean that."""
    return known_on_board(seen, mission_id) >= over


def stands_ready(seen: Seen) -> bool:
    """Whether the robot stands on the ground, told of a mission: it may take off for that."""
    return seen.guard is GuardState.GROUND and seen.mission_id != 0


def harm_in(
    seen: Seen, mission_id: int, world: str, expected: tuple[int, ...], over: int
) -> tuple[str, str] | None:
    """Say what ends a mission that is under way, if anything seen does: code and text.

    Args:
        seen: The newest telemetry.
        mission_id: Of the mission.
        world: In which it was started, or `ANY_WORLD`.
        expected: Missions that may be on board: this one, once the robot has been told of it, or
            before that the one that a mission from here has found; empty if it may be any.
        over: See `is_over`.
    """
    if world not in (ANY_WORLD, seen.world):
        return "world_restarted", "world restarted"
    if expected and seen.mission_id not in expected:
        return "taken_over", "somebody else has started another mission"
    if is_over(seen, mission_id, over):
        return END_LOST
    if seen.guard > WORST_GUARD:
        return "guard_stopped", f"guard went to {seen.guard.name} ({seen.cause.words})"
    return None
