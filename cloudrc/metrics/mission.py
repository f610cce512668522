"""Metrics of the mission: waypoints, contacts, steady error, holds of the guard, and faults."""

from __future__ import annotations

from functools import partial

import numpy as np

from cloudrc.messages import GuardState
from cloudrc.metrics.flight import Array, Flight, Metric, mean

BOARD = "board"
"""Name of the scene's body that the arm must touch."""
PRESSING_NS = 2_000_000_000
"""Length of the last part of the mission, over which the steady contact force is averaged [ns]."""
RESTING_NS = 5_000_000_000
"""Length of the last part of the flight, over which the steady error is averaged [ns]."""
SETTLING_NS = 10_000_000_000
"""Time before the last RESTING_NS in which the setpoint must not move [ns]; otherwise there is no
steady error.
Source: docs/reference/control.md, "Steady state": the slowest variant that settles needs 8 to 15 s
to stay within 1 cm."""
FAILURES = ("estimator_failed", "predictor_failed", "controller_failed", "horizon_clamped")
"""Names of cloud's counters whose values are added to the number of faults."""


def _waypoints_reached(flight: Flight) -> float | None:
    if flight.start_ns is None:
        return None
    mission = flight.during("/mission")
    return float(len(np.unique(mission["waypoint"][mission["event"] == "reached"])))


def first_touch(flight: Flight) -> dict[str, Array] | None:
    """Find the row of /contact at which the arm first touched the board; None without a touch."""
    contact = flight.during("/contact")
    touches = np.flatnonzero((contact["body"] == BOARD) & contact["tip"].astype(bool))
    return {name: column[touches[0]] for name, column in contact.items()} if len(touches) else None


def _contact_time(flight: Flight) -> float | None:
    touch = first_touch(flight)
    return None if touch is None else float(flight.seconds(touch["stamp_ns"]))


def _tip_speed(flight: Flight) -> float | None:
    touch = first_touch(flight)
    return None if touch is None else float(np.linalg.norm(touch["tip_velocity"]))


def _peak_contact_force(flight: Flight) -> float | None:
    """Return the largest force on the touch sensor; None if the arm never touched the board.

    The peak depends on the simulator's contact parameters: compare only flights in the same scene.
    """
    if first_touch(flight) is None:
        return None
    force = flight.during("/contact_force")["tip_force"]
    return float(force.max()) if len(force) else None


def _steady_contact_force(flight: Flight) -> float | None:
    """Average the force on the touch sensor over the last part of a completed mission.

    Unlike the peak at impact, the steady force does not depend on the simulator's contact
    parameters.
    """
    touch = first_touch(flight)
    if touch is None or flight.ending is None or flight.ending[1] != "done":
        return None
    begin_ns = flight.ending[0] - PRESSING_NS
    if touch["stamp_ns"] > begin_ns:
        return None
    force = flight.during("/contact_force")
    return mean(force["tip_force"][force["stamp_ns"] >= begin_ns])


def _pipe_contacts(flight: Flight) -> float | None:
    if flight.start_ns is None or not flight.scene.pipes:
        return None
    bodies = flight.during("/contact")["body"]
    return float(np.sum([str(body).startswith("pipe") for body in bodies]))


def _steady_error(flight: Flight, axis: int) -> float | None:
    """Average the distance between true position and setpoint along one axis.

    Args:
        flight: Any flight.
        axis: 0, 1 or 2 for x, y or z, world frame.

    Returns:
        Mean absolute error over the last 5 s [m]. None if the setpoint moved or the arm touched
        something in the last 15 s, or if the flight is shorter.
    """
    control = flight.control
    if flight.end_ns is None or flight.start_ns is None:
        return None
    begin_ns = flight.end_ns - RESTING_NS
    still = control["setpoint"][control["stamp_ns"] >= begin_ns - SETTLING_NS]
    force = flight.during("/contact_force")
    touched = (force["tip_force"][force["stamp_ns"] >= begin_ns - SETTLING_NS] > 0).any()
    too_short = begin_ns - SETTLING_NS < flight.start_ns
    if too_short or touched or not len(still) or (still != still[-1]).any():
        return None
    truth = flight.truth
    rows = truth["stamp_ns"] >= begin_ns
    return float(np.abs(truth["position"][rows, axis] - still[-1, axis]).mean())


def holds(flight: Flight) -> list[tuple[int, int]]:
    """List the intervals in HOLD during the flight.

    Returns:
        Start and end of each interval [ns], world's clock, in order.
    """
    if flight.end_ns is None:
        return []
    guard = flight.during("/guard")
    ends = [*guard["stamp_ns"][1:], flight.end_ns]
    return [
        (int(start), int(end))
        for start, end, state in zip(guard["stamp_ns"], ends, guard["state"], strict=True)
        if state == GuardState.HOLD
    ]


def hold_count(flight: Flight) -> float | None:
    """Count the intervals in HOLD before the mission's end [1]; None if the robot never flew."""
    return None if flight.start_ns is None else float(len(holds(flight)))


def _hold_time(flight: Flight) -> float | None:
    if flight.start_ns is None:
        return None
    return sum(end - start for start, end in holds(flight)) * 1e-9


def _fault_count(flight: Flight) -> float | None:
    """Sum the failures that cloud counted and all other recorded faults.

    A failure that repeats has only one fault record; its counter contains every repetition.
    """
    if flight.start_ns is None:
        return None
    count, faults = flight.recording["/count"], flight.recording["/fault"]["code"]
    totals = dict.fromkeys(FAILURES, 0)
    for name, total in zip(count["name"], count["total"], strict=True):
        if name in totals:
            totals[name] = max(totals[name], int(total))
    for code in faults:
        totals[code] = max(totals.get(code, 0), 1)
    return float(sum(totals.values()))


def _recorder_dropped(flight: Flight) -> float | None:
    """Sum both ends' last counts of dropped records; None without counts."""
    count = flight.recording["/count"]
    last = {
        str(end): int(value)
        for end, name, value in zip(count["end"], count["name"], count["total"], strict=True)
        if name == "recorder_dropped"
    }
    return float(sum(last.values())) if last else None


METRICS = (
    Metric(
        "waypoints_reached",
        "1",
        "Number of waypoints reached: the robot stayed within the tolerance for the dwell time.",
        _waypoints_reached,
    ),
    Metric(
        "contact_time",
        "s",
        "Time from the start of the mission to the arm's first touch of the board.",
        _contact_time,
    ),
    Metric(
        "tip_speed",
        "m/s",
        "Speed of the arm's tip just before it first touches the board.",
        _tip_speed,
    ),
    Metric(
        "peak_contact_force",
        "N",
        "Largest force on the arm's tip, as sampled at 100 Hz.",
        _peak_contact_force,
    ),
    Metric(
        "steady_contact_force",
        "N",
        "Mean force on the arm's tip over the last 2 s of the mission.",
        _steady_contact_force,
    ),
    Metric("pipe_contacts", "1", "Number of contacts with a pipe.", _pipe_contacts),
    *(
        Metric(
            f"steady_error_{name}",
            "m",
            f"Mean distance from the setpoint along {name} over the last 5 s of a hover.",
            partial(_steady_error, axis=axis),
        )
        for axis, name in enumerate("xyz")
    ),
    Metric(
        "hold_count",
        "1",
        "Number of times that the guard went to HOLD because fresh commands were missing.",
        hold_count,
    ),
    Metric(
        "hold_time",
        "s",
        "Total time in HOLD, in which the guard flies without commands.",
        _hold_time,
    ),
    Metric(
        "fault_count",
        "1",
        "Number of faults that did not stop the flight, such as an exception in a predictor.",
        _fault_count,
    ),
    Metric(
        "recorder_dropped",
        "1",
        "Number of records that the recorder dropped because the loop must not wait for the disk.",
        _recorder_dropped,
    ),
)
