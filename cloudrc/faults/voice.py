"""The operator's words in the mouth of a hostile cloud, said when they do the most harm.

World cannot tell who speaks: cloud carries the operator's requests, sealed with its own keys. So a
hostile one starts, ends, stops and acknowledges as it likes: at speed, at a face of the fence, in
the middle of a fall. (Hold and resume are no words to world: an end of the mission is as good, and
a start from where the robot is.)
"""

from __future__ import annotations

import numpy as np

from cloudrc.faults.liar import Words
from cloudrc.geometry.fence import HIGH, LOW
from cloudrc.messages import MISSION_OVER, GuardState, OperatorRequest, Request, Start, Vector
from cloudrc.records import Control

Generator = np.random.Generator

BEGIN = OperatorRequest(0, Request.START, Start.HERE)
AGAIN = OperatorRequest(0, Request.START, Start.SPAWN)
END, STOP, RELEASE, PROGRESS = (
    OperatorRequest(0, request)
    for request in (Request.END, Request.ESTOP, Request.ACKNOWLEDGE, Request.PROGRESS)
)
FLYING = {BEGIN: 0.35, END: 0.3, STOP: 0.15, RELEASE: 0.1, PROGRESS: 0.07, AGAIN: 0.03}
LATCHED = {RELEASE: 0.7, BEGIN: 0.2, STOP: 0.1}
CHOICES = {
    GuardState.GROUND: {BEGIN: 0.6, AGAIN: 0.25, END: 0.05, STOP: 0.05, RELEASE: 0.05},
    GuardState.TRACK: FLYING,
    GuardState.HOLD: FLYING,
    GuardState.LAND: LATCHED,
    GuardState.ESTOP: LATCHED,
}
"""How likely each is, by the state that cloud knows of."""
PATIENCE_NS = 5_000_000_000
"""For the robot to come near a face [ns]."""
REACHED = (0, 1, 7, MISSION_OVER)


def at_bad_moments(rng: Generator) -> Words:
    """Speak after random whiles; every second time wait for the robot to fly near a face."""
    pause, near = float(rng.choice([0.05, 0.3, 1.0])), float(rng.uniform(0.2, 1.5))
    due_ns, waits = 0, False

    def words(control: Control, guard: GuardState) -> OperatorRequest | None:
        nonlocal due_ns, waits
        far = guard is GuardState.TRACK and distance(control.measured) > near
        until_ns = due_ns + PATIENCE_NS if far and waits else due_ns
        if control.stamp_ns < until_ns:
            return None
        due_ns = control.stamp_ns + int(rng.exponential(pause) * 1e9)
        waits = bool(rng.random() < 0.5)
        said, likely = zip(*CHOICES[guard].items(), strict=True)
        chosen: OperatorRequest = said[int(rng.choice(len(said), p=likely))]
        mission, reached = int(rng.integers(0, 3)), REACHED[int(rng.integers(len(REACHED)))]
        return chosen._replace(mission_id=mission, reached=reached)

    return words


def distance(position: Vector) -> float:
    """How far a base at `position` [m], shape (3,), is from the nearest wall or the ceiling [m]."""
    return min(
        HIGH[2] - position[2],
        *(min(position[n] - LOW[n], HIGH[n] - position[n]) for n in (0, 1)),
    )
