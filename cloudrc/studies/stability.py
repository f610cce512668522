# SPDX-License-Identifier: Apache-2.0

"""Decide whether a control loop is stable: fly one step of the setpoint, and see if it dies out.

Two flights with the same random numbers differ in the step alone: both hover at a point, and in one
of them the setpoint then moves by a step along x, y and z, or along x and y if the robot stays on
the ground. The *response* is the difference of the two positions minus the step: what is left of
the step. In a linear loop, wind, sensor noise and losses act equally on both flights, so they
cancel in the response. The response of a stable loop dies out, that of an unstable loop does not.

The judged step is small. The limits of the guard (speed, acceleration, fence) bound a large
oscillation, so that a loop that is unstable may seem to decay after a large step.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cloudrc.base.outside import code
from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.config.schema import Criteria, MissionConfig, Waypoint
from cloudrc.flight.ages import simulate_ages
from cloudrc.flight.in_memory import explain
from cloudrc.flight.virtual.flight import fly_virtual
from cloudrc.physics.geometry.scene import load_scene
from cloudrc.results.metrics.counters import growth
from cloudrc.results.metrics.verdict import NOT_STARTED, plugin_failures
from cloudrc.results.record.columns import Recording, RecordStore
from cloudrc.results.record.holes import END_NS
from cloudrc.wire.messages import GuardState
from cloudrc.wire.records import (
    Control,
    Counted,
    Fault,
    GroundTruth,
    GuardChange,
    MissionEvent,
    Record,
)

Array = NDArray[np.float64]
SCENE = "empty"
"""Scene of the step, in which nothing is in the way."""
SMALL, LARGE = 0.1, 1.0
"""Step along each axis with which stability is judged, and step that a user would fly [m]."""
END_HEIGHT = 1.4
"""Height of the setpoint after the step [m]. The fence leaves 0.9 m above it and 1 m below it."""
WINDOWS = 6
"""Number of windows in which the response is observed. The last two are compared with the two
before them."""
PERIODS, LAG, WINDOW_MIN = 4.0, 0.5, 4.0
"""Duration of a window: PERIODS times the sum of the loop's mean delay and LAG, at least
WINDOW_MIN [s]. A loop of an integrator and a delay oscillates at its limit of stability with a
period of four delays; LAG stands for the robot's own delay."""
TAKE_OFF = 8.0
"""Shortest hover before the step [s]."""
START_MAX = 60.0
"""Longest time until a flight begins [s]; longer is given up."""
GONE = 0.05
"""The response has died out if its rms in the last two windows is below this share of the step."""
SHRINKS, SMALLER = 0.95, 0.5
"""A response that has not died out yet is stable, too, if its rms in the last two windows is below
SHRINKS times that of the two windows before, and below SMALLER times the step."""
KEPT = (Control, Counted, Fault, GroundTruth, GuardChange, MissionEvent)
"""Kinds of records that are kept of a flight; to keep all takes as long as to fly."""
HELD_MAX = 0.5
"""Largest share of the time after the step in which the guard may hold the robot."""
Answer = dict[str, Any]
"""Result of `fly_step`: `stable`; if it is false, `code` and `text`; `left`, the response at the
end as a share of the step; `speed_limited`, the share of commands after the step that the guard's
speed cap shortened."""


class Track(NamedTuple):
    """What one flight tells about the response to a step."""

    stamps_ns: NDArray[np.int64]  # of the samples [ns], world's clock, shape (n,)
    positions: Array  # true position of the base [m], world frame, shape (n, 3)
    step_ns: int  # time of the step [ns], world's clock
    speed_limited: float  # share of the commands after the step that the speed cap shortened [1]
    problem: tuple[str, str] | None  # code and text of why the response is not known


def fly_step(experiment: ResolvedExperiment, size: float = SMALL) -> Answer:
    """Fly both flights in virtual time, and say whether a step of `size` [m] per axis dies out.

    Raises:
        MissingPrerequisiteError: If the machine failed, not the flight.
    """
    try:
        return _fly_step(experiment, size)
    except code.FAILURES as error:  # a value that cannot fly must not stop the search
        return {"stable": False, "code": "error", "text": explain(error)}


def _fly_step(experiment: ResolvedExperiment, size: float) -> Answer:
    window = window_of(experiment)
    if experiment.robot.planar:
        start, step = np.array(load_scene(SCENE).spawn), np.array((size, size, 0.0))
    else:
        start, step = np.array((0.0, 0.0, END_HEIGHT - size)), np.full(3, size)
    end = start + step
    tracks = []
    for point in (end, start):
        track = fly(experiment, start, point, window)
        if track.problem:
            return {"stable": False, "code": track.problem[0], "text": track.problem[1]}
        tracks.append(track)
    stepped, still = tracks
    answer = judge(response(stepped, still, step), stepped.step_ns, window, size)
    return answer | {"speed_limited": stepped.speed_limited}


def window_of(experiment: ResolvedExperiment) -> float:
    """Return the duration of a window [s], about one period at the limit of stability."""
    ages, _ = simulate_ages(experiment)
    delay = sum(ages) / len(ages) if ages else 0.0
    return max(WINDOW_MIN, PERIODS * (delay + LAG))


def fly(experiment: ResolvedExperiment, start: Array, end: Array, window: float) -> Track:
    """Hover at `start` [m], move the setpoint to `end` [m], and observe WINDOWS of `window` [s]."""
    store = RecordStore()

    def see(world: list[Record], cloud: list[Record]) -> None:
        store.add(*([one for one in each if isinstance(one, KEPT)] for each in (world, cloud)))

    fly_virtual(_with_step(experiment, start, end, window), see)
    return _track(Recording(records=store))


def _with_step(
    experiment: ResolvedExperiment, start: Array, end: Array, window: float
) -> ResolvedExperiment:
    """Return the experiment with a hover and a step in place of its scene, mission and criteria.

    The setpoint stays at a point for a given time, wherever the robot is: the tolerance is larger
    than the fence.
    """
    times = max(TAKE_OFF, window), WINDOWS * window
    limit = START_MAX + 2.0 * sum(times)
    points = [
        Waypoint(
            position_m=tuple(point.tolist()), tolerance_m=1e3, dwell_s=dwell, time_limit_s=limit
        )
        for point, dwell in zip((start, end), times, strict=True)
    ]
    changed = {
        "mission": MissionConfig(waypoints=tuple(points)),
        "criteria": Criteria(settle_m=None, time_limit_s=limit),
        "world": experiment.world.model_copy(update={"scene": SCENE, "fence_m": None}),
    }
    return experiment.model_copy(update=changed)


def _track(recording: Recording) -> Track:
    truth, mission = recording["/ground_truth"], recording["/mission"]
    reached = mission["stamp_ns"][mission["event"] == "reached"]
    step_ns = int(reached[0]) if len(reached) else 0
    commands = int((recording["/cmd_vel"]["stamp_ns"] > step_ns).sum())
    limited = (growth(recording, "limited_speed", (step_ns, END_NS)) or 0.0) / max(commands, 1)
    problem = _problem(recording, step_ns)
    return Track(truth["stamp_ns"], truth["position"], step_ns, limited, problem)


def _problem(recording: Recording, step_ns: int) -> tuple[str, str] | None:
    """Return code and text of why a flight shows no response to the step at `step_ns` [ns]."""
    for failure in plugin_failures(recording, None):  # the response is not that of the plug-in
        return failure.code, failure.text
    guard, mission = recording["/guard"], recording["/mission"]
    if not (guard["state"] == GuardState.TRACK).any():
        return "not_started", NOT_STARTED
    events, texts = ["not_ended", *mission["event"]], ["", *mission["text"]]
    if events[-1] != "done":
        return events[-1], f"the flight ended early: {texts[-1] or guard['cause'][-1]}"
    end_ns = int(mission["stamp_ns"][-1])
    begins = np.clip(guard["stamp_ns"], step_ns, end_ns)
    lasts = np.diff(begins, append=end_ns)
    held = lasts[guard["state"] == GuardState.HOLD].sum() / max(end_ns - step_ns, 1)
    if held > HELD_MAX:
        why = "commands were older than guard.command_age_max_ms"
        return "held", f"the guard held the robot for {held:.0%} of the time, because {why}"
    return None


def response(stepped: Track, still: Track, step: Array) -> tuple[NDArray[np.int64], Array]:
    """Return what is left of a `step` [m], shape (3,): stamps [ns] and response [m].

    The shapes are (n,) and (n, 3). The response is -`step` at the step, and 0 when it has died out.
    """
    count = min(len(stepped.positions), len(still.positions))
    left = stepped.positions[:count] - still.positions[:count] - step
    return stepped.stamps_ns[:count], left


def judge(
    found: tuple[NDArray[np.int64], Array], step_ns: int, window: float, size: float
) -> Answer:
    """Say whether a response dies out, and along which axis it does not.

    Args:
        found: Stamps [ns], shape (n,), and response [m], shape (n, 3).
        step_ns: Time of the step [ns].
        window: Duration of a window [s].
        size: Size of the step per axis [m].
    """
    times, left = (found[0] - step_ns) * 1e-9 / window, found[1]
    early, late = (
        np.sqrt(np.square(left[(times >= first) & (times < first + 2)]).mean(axis=0))
        for first in (WINDOWS - 4, WINDOWS - 2)
    )
    gone = late < GONE * size
    dies = (late < SHRINKS * early) & (late < SMALLER * size)
    bad = ~(gone | dies)
    answer: Answer = {"stable": not bad.any(), "left": float(late.max() / size)}
    if bad.any():
        axis = int(np.where(bad, late, 0.0).argmax())
        text = (
            f"a step of {size:g} m in {'xyz'[axis]} does not die out: {late[axis]:.2g} m are left"
        )
        answer |= {"code": "unstable", "text": text}
    return answer
