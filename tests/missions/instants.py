"""When the cloud falls silent, or is killed: 200 instants in the pipes, 200 anywhere."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from flying import fly
from silence import PATIENCE

from cloudrc.geometry.clearance import pipe_index
from cloudrc.metrics import Flight

COUNT = 200
DAILY = range(COUNT)[13::40]
"""Indices of those in the pipes that are not left to the night."""
REST = [k for k in range(COUNT) if k not in DAILY]
LAST_S = 27.0
"""Uncapped the board is touched 1 s later; at 1.5 m/s 4.9 s later, 2.2 s after pipe 3's mouth."""
ANYWHERE = [round(1.5 + k * (LAST_S - 1.5) / (COUNT - 1), 3) for k in range(COUNT)]
"""Evenly from the first waypoint on [s], before, in and between the pipes: half are in one."""
DAILY_ANYWHERE = ANYWHERE[13::160]
"""Before pipe 1, and at 1.5 m/s between pipes 2 and 3."""
REST_ANYWHERE = [start_s for start_s in ANYWHERE if start_s not in DAILY_ANYWHERE]
ENDING_NS = 100_000_000
"""Before a mission's end [ns]: what was sent before a silence this late still ends the mission, and
there is nothing left to resume."""


class MidPipe(NamedTuple):
    """An instant [s] at which the undisturbed robot's base is in the pipe of this index."""

    start_s: float
    pipe: int


@cache
def undisturbed(*settings: str) -> Flight:
    """The flight without any silence or kill."""
    return fly("paper", *PATIENCE, *settings).flight


@cache
def mid_pipe(*settings: str) -> tuple[MidPipe, ...]:
    """200 instants, evenly over the time in which the undisturbed robot's base is in a pipe.

    In pipes 1, 2 and 3 are 47, 51 and 102 of them at 1.5 m/s, 41, 48 and 111 uncapped: the robot
    touches the board from within pipe 3.
    """
    flight = undisturbed(*settings)
    stamps_ns, inside = flight.truth["stamp_ns"], flight.inside
    early = stamps_ns[1:] <= flight.end_ns - ENDING_NS
    steps = np.flatnonzero(inside[:-1] & inside[1:] & early)
    spent_ns = np.cumsum((stamps_ns[1:] - stamps_ns[:-1])[steps])
    wanted_ns = (np.arange(COUNT) + 0.5) * spent_ns[-1] / COUNT
    found = np.searchsorted(spent_ns, wanted_ns)
    at_ns = stamps_ns[steps[found] + 1] - (spent_ns[found] - wanted_ns)
    at_ms = (at_ns // 1_000_000).astype(np.int64)
    pipes = pipe_index(flight.scene, flight.true_position(at_ms * 1_000_000))
    assert len(set(at_ms.tolist())) == COUNT
    assert (pipes >= 0).all()
    return tuple(map(MidPipe, (at_ms / 1000).tolist(), pipes.tolist()))
