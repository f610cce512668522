"""Metrics of the mission: waypoints, contacts, steady error, holds of the guard, and faults."""

from __future__ import annotations

from functools import partial

import numpy as np

from cloudrc.messages import GuardState
from cloudrc.metrics.flight import Array, Flight, add_metric, mean, metric

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


@metric("1")
def waypoints_reached(flight: Flight) -> float | None:
    """Number of waypoints reached: the robot stayed within the tolerance for the dwell time."""
    if flight.start_ns is None:
        return None
    mission = flight.during("/mission")
    return float(len(np.unique(mission["waypoint"][mission["event"] == "reached"])))


def first_touch(flight: Flight) -> dict[str, Array] | None:
    """Find the row of /contact at which the arm first touched the board; None without a touch."""
    contact = flight.during("/contact")
    touches = np.flatnonzero((contact["body"] == BOARD) & contact["tip"].astype(bool))
    return {name: column[touches[0]] for name, column in contact.items()} if len(touches) else None


@metric("s")
def contact_time(flight: Flight) -> float | None:
    """Time from the start of the mission to the arm's first touch of the board."""
    touch = first_touch(flight)
    return None if touch is None else float(flight.seconds(touch["stamp_ns"]))


@metric("m/s")
def tip_speed(flight: Flight) -> float | None:
    """Speed of the arm's tip just before it first touches the board."""
    touch = first_touch(flight)
    return None if touch is None else float(np.linalg.norm(touch["tip_velocity"]))


@metric("N")
def peak_contact_force(flight: Flight) -> float | None:
    """Largest force on the arm's tip, as sampled at 100 Hz.

    It depends on the simulator's contact parameters: compare only flights in the same scene.
    """
    force = flight.during("/contact_force")["tip_force"]
    return None if first_touch(flight) is None or not len(force) else float(force.max())


@metric("N")
def steady_contact_force(flight: Flight) -> float | None:
    """Mean force on the arm's tip over the last 2 s of the mission.

    Unlike the peak at impact, it does not depend on the simulator's contact parameters.
    """
    touch = first_touch(flight)
    if touch is None or flight.ending is None or flight.ending[1] != "done":
        return None
    begin_ns = flight.ending[0] - PRESSING_NS
    if touch["stamp_ns"] > begin_ns:
        return None
    force = flight.during("/contact_force")
    return mean(force["tip_force"][force["stamp_ns"] >= begin_ns])


@metric("1")
def pipe_contacts(flight: Flight) -> float | None:
    """Number of contacts with a pipe."""
    if flight.start_ns is None or not flight.scene.pipes:
        return None
    bodies = flight.during("/contact")["body"]
    return float(np.sum([str(body).startswith("pipe") for body in bodies]))


def _steady_error(flight: Flight, axis: int) -> float | None:
    """Average the distance from setpoint to true position along x, y or z (`axis` 0, 1 or 2) [m].

    None if the setpoint moved or the arm touched something in the last 15 s, or if the flight is
    shorter.
    """
    control, force = flight.control, flight.during("/contact_force")
    if flight.end_ns is None or flight.start_ns is None:
        return None
    begin_ns = flight.end_ns - RESTING_NS
    settling_ns = begin_ns - SETTLING_NS
    still = control["setpoint"][control["stamp_ns"] >= settling_ns]
    touched = (force["tip_force"][force["stamp_ns"] >= settling_ns] > 0).any()
    too_short = settling_ns < flight.start_ns
    if too_short or touched or not len(still) or (still != still[-1]).any():
        return None
    rows = flight.truth["stamp_ns"] >= begin_ns
    return float(np.abs(flight.truth["position"][rows, axis] - still[-1, axis]).mean())


for _axis, _name in enumerate("xyz"):
    add_metric(
        f"steady_error_{_name}",
        "m",
        f"Mean distance from the setpoint along {_name} over the last 5 s of a hover.",
        partial(_steady_error, axis=_axis),
    )


def holds(flight: Flight) -> list[tuple[int, int]]:
    """List start and end of each interval in HOLD during the flight [ns], world's clock."""
    if flight.end_ns is None:
        return []
    guard = flight.during("/guard")
    ends = [*guard["stamp_ns"][1:], flight.end_ns]
    return [
        (int(start), int(end))
        for start, end, state in zip(guard["stamp_ns"], ends, guard["state"], strict=True)
        if state == GuardState.HOLD
    ]


@metric("1")
def hold_count(flight: Flight) -> float | None:
    """Number of times that the guard went to HOLD because fresh commands were missing."""
    return None if flight.start_ns is None else float(len(holds(flight)))


@metric("s")
def hold_time(flight: Flight) -> float | None:
    """Total time in HOLD, in which the guard flies without commands."""
    if flight.start_ns is None:
        return None
    return sum(end - start for start, end in holds(flight)) * 1e-9


@metric("1")
def fault_count(flight: Flight) -> float | None:
    """Number of faults that did not stop the flight, such as an exception in a predictor.

    A failure that repeats has only one fault record; its counter contains every repetition.
    """
    if flight.start_ns is None:
        return None
    count = flight.recording["/count"]
    totals = dict.fromkeys(flight.recording["/fault"]["code"], 1)
    for name, total in zip(count["name"], count["total"], strict=True):
        if name in FAILURES:
            totals[name] = max(totals.get(name, 0), int(total))
    return float(sum(totals.values()))


@metric("1")
def recorder_dropped(flight: Flight) -> float | None:
    """Number of records that the recorder dropped because the loop must not wait for a disk."""
    count = flight.recording["/count"]
    rows = zip(count["end"], count["name"], count["total"], strict=True)
    last = {end: int(value) for end, name, value in rows if name == "recorder_dropped"}
    return float(sum(last.values())) if last else None
