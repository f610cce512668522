# SPDX-License-Identifier: Apache-2.0

"""Metrics of the mission: waypoints, contacts, steady error, time in HOLD, and faults."""

from __future__ import annotations

from functools import partial
from math import radians
from typing import TYPE_CHECKING

import numpy as np

from cloudrc.base.rounding import differences, exceeds
from cloudrc.physics.geometry.scene import is_obstacle
from cloudrc.results.metrics.definitions import Holds
from cloudrc.results.metrics.flight import (
    Array,
    Flight,
    add_measures,
    between,
    finite,
    mean,
    rms,
    rows_of,
    select,
    turn_between,
    yaw_of,
)
from cloudrc.results.record.merge import machine_time_ns

if TYPE_CHECKING:
    from cloudrc.config.schema import Waypoint

IMPACT_NS = 100_000_000
"""Time from the first touch over which the impulse is summed [ns]: the impact and its bounces."""
ODOMETRY_NS = 10_000_000
"""Time between two rows of the true position [ns]."""
NOISE = 3.0
"""Factor on the noise of the measured positions, by which a waypoint's tolerance is larger for the
true position [1]: the operator cannot know better that the robot is there."""
PRESSING_NS = 2_000_000_000
"""Last part of the mission, over which the steady contact force is averaged [ns]."""
RESTING_NS = 5_000_000_000
"""Last part of the flight, over which the steady error is averaged [ns]."""
SETTLING_NS = 10_000_000_000
"""Time before the last RESTING_NS in which the setpoint must be constant [ns]. If it moved, there
is no steady error.
Source: docs/reference/control.md, "Steady state": the slowest variant that settles needs 8 to 15 s
to stay within 1 cm."""
FAILURES = ("estimator_failed", "predictor_failed", "controller_failed", "perception_failed")
"""Counters of cloud that are included in the number of faults."""


def holds(flight: Flight) -> list[tuple[int, int]]:
    """List start and end of each HOLD that interrupted the flight [ns], world's clock."""
    measured, found = Holds(), list[tuple[int, int]]()
    for change in rows_of(flight.during("/guard"), "stamp_ns", "state", "cause"):
        found += measured.take(*change)
    return found if flight.end_ns is None else found + measured.end(flight.end_ns)


def came_up(flight: Flight, link_start: float) -> float:
    """Return when the link came up, in seconds since the start of the mission.

    `link_start` is where its schedule began [s]. The processes of a link tell it. In virtual time
    it comes up at 0 on world's clock, which takes the first sample then. Else telemetry may be the
    first to cross it.
    """
    recording, seconds = flight.recording, flight.seconds
    link, truth = recording["/link"], recording["/ground_truth"]["stamp_ns"]
    if len(link):
        return float(seconds(link["stamp_ns"][0]) - link["time_line"][0]) + link_start
    if len(truth) and truth[0] == 0:
        return float(seconds(0))
    sent = recording["/telemetry"]["stamp_ns"]
    return float(seconds(sent[0])) if len(sent) else 0.0


def reported(flight: Flight) -> dict[int, int]:
    """Return the waypoints that teleop reported as reached: index -> stamp of the report [ns].

    If the mission is judged by predictions, it is the time for which the prediction was made.
    """
    mission = flight.during("/mission")
    reached = select(mission, mission["event"] == "reached")
    stamps = reached["stamp_ns"]
    if flight.mission.judged_by == "predicted" and len(flight.control["stamp_ns"]):
        row = np.searchsorted(flight.control["stamp_ns"], stamps, side="right") - 1
        ahead = select(flight.control, np.maximum(row, 0))
        stamps = ahead["basis_stamp_ns"] + np.round(ahead["horizon"] * 1e9).astype(np.int64)
    return dict(zip(reached["waypoint"].tolist(), stamps.tolist(), strict=True))


def _waypoints_reached(flight: Flight) -> float | None:
    """Count the waypoints that teleop reported as reached and the true position confirms.

    None if messages are lost and the others do not prove all waypoints.
    """
    stamps, points = reported(flight), flight.mission.waypoints
    if flight.mission.steps or flight.mission.follow:  # they end after their time, anywhere
        count = len(stamps)
    elif flight.mission.setpoints is not None:
        count = int(bool(stamps) and missed_end(flight) is None)
    else:
        known = (i for i in stamps if i < len(points))
        count = sum(_stay(flight, points[i], stamps[i])[0] for i in known)
    wanted = 1 if flight.mission.setpoints else flight.mission.count
    return None if flight.holes and count < wanted else flight.count(count)


def _yaw_error(flight: Flight) -> float | None:
    """Find the largest error of the true yaw when a waypoint with a yaw was reached [rad]."""
    truth, points, errors = flight.truth, flight.mission.waypoints, list[float]()
    for index, stamp_ns in reported(flight).items():
        yaw = points[index].yaw_deg if index < len(points) else None
        row = np.searchsorted(truth["stamp_ns"], stamp_ns, side="right") - 1
        if yaw is not None and row >= 0:
            now = yaw_of(truth["orientation_wxyz"][[row]])
            errors.append(abs(float(turn_between(now, radians(yaw))[0])))
    return max(errors, default=None)


def _final_error(flight: Flight) -> float | None:
    """Measure how far the robot was from the last setpoint of a file at the mission's end [m]."""
    driven = "driving" in flight.during("/mission")["event"]  # the file has what was driven
    if flight.mission.setpoints is None or flight.ending is None or driven or flight.holes:
        return None
    end_ns, event, _ = flight.ending
    control = flight.control
    setpoints = control["setpoint"][(control["waypoint"] >= 0) & (control["stamp_ns"] <= end_ns)]
    if event != "done" or not len(setpoints):
        return None
    true = flight.true_position(np.array([end_ns]))[0]
    return finite(float(np.linalg.norm(true - setpoints[-1])))


def missed_end(flight: Flight) -> float | None:
    """Return the distance from the last setpoint of a file [m] if it is above the tolerance.

    As for a waypoint, the noise of the measured positions adds to the tolerance. None: it is not
    above, or the mission has no such setpoint.
    """
    error, tolerance = _final_error(flight), flight.criteria.settle_m
    if error is None or tolerance is None:
        return None
    return error if exceeds(error, tolerance + NOISE * flight.position_noise) else None


def _stay(flight: Flight, waypoint: Waypoint, until_ns: int) -> tuple[bool, str]:
    """Look at what the robot did before teleop reported a waypoint as reached, at `until_ns` [ns].

    The true position counts, give or take `NOISE` times the noise of the measured positions, which
    are all that the operator sees, and likewise the true yaw if the waypoint has one. Times count
    on the operator's clock, as in teleop: it goes on while world's clock lags behind.

    Return whether the robot stayed near the waypoint for its dwell time. If not, also say where it
    was when it was first away in the dwell time; "" if it never was.
    """
    truth = between(flight.recording["/ground_truth"].columns, flight.start_ns or 0, until_ns)
    stamps_ns, turned = truth["stamp_ns"], ""
    distance = np.linalg.norm(truth["position"] - waypoint.position_m, axis=1)
    there = differences(waypoint.tolerance_m + NOISE * flight.position_noise, distance) <= 0.0
    if waypoint.yaw_deg is not None:
        yaws = yaw_of(truth["orientation_wxyz"])
        turn = np.abs(turn_between(yaws, radians(waypoint.yaw_deg)))
        there &= differences(waypoint.yaw_tolerance + NOISE * _yaw_noise(flight), turn) <= 0.0
        turned = " or not turned as asked"
    # If the mission has a `carrot` (a moving setpoint), a stay of any length is enough, because the
    # setpoint waits at the waypoint for the dwell time.
    dwell_ns = 0.0 if flight.mission.carrot else waypoint.dwell_s * 1e9
    # At `until_ns` the robot is where the last row shows it.
    telemetry = flight.recording["/telemetry"]
    operator_ns = machine_time_ns(telemetry, np.append(stamps_ns, until_ns))
    edges = np.flatnonzero(np.diff(np.pad(np.append(there, there[-1:]), 1)))
    stays_ns = operator_ns[edges[1::2] - 1] - operator_ns[edges[::2]]
    if (stays_ns >= dwell_ns - ODOMETRY_NS).any():  # it may begin between two samples
        return True, ""
    begin = int(operator_ns[:-1].searchsorted(operator_ns[-1] - dwell_ns, "right")) - 1
    away = np.flatnonzero(~there)
    if not (away := away[away >= begin]).size:
        return False, ""
    seconds = flight.seconds(stamps_ns[away[0]])
    return False, f"{distance[away[0]]:.4g} m from it{turned} at {seconds:.2f} s"


def _yaw_noise(flight: Flight) -> float:
    """Return the root mean square of the error of the measured yaws [rad]; 0 if unknown."""
    measured, truth = flight.during("/odometry"), flight.recording["/ground_truth"]
    rows = np.searchsorted(truth["stamp_ns"], measured["stamp_ns"])
    known = rows < len(truth["stamp_ns"])
    true = yaw_of(truth["orientation_wxyz"][rows[known]])
    errors = turn_between(yaw_of(measured["orientation_wxyz"][known]), true)
    return rms(errors) or 0.0


def unconfirmed(flight: Flight) -> str:
    """Say where the robot was at the first waypoint that teleop alone saw as reached; "" if none.

    Teleop knows neither the noise of a measurement nor the path between two messages.
    """
    points = flight.mission.waypoints
    for index, stamp_ns in reported(flight).items():
        if index < len(points) and (where := _stay(flight, points[index], stamp_ns)[1]):
            return f"in the dwell time at waypoint {index + 1} the robot was {where}"
    return ""


def _peak_force(flight: Flight) -> float | None:
    """Find the largest contact force [N]; it depends on the simulator's contact parameters."""
    force = flight.during("/contact_force")["force_peak"]
    return float(force.max()) if flight.first_touch and len(force) else None


def _impulse(flight: Flight) -> float | None:
    """Integrate the force of the impact over time [N s].

    Unlike the peak force, the impulse does not depend on the simulator's contact parameters.

    Source: docs/reference/plant.md, "Contact".
    """
    touch, force = flight.first_touch, flight.during("/contact_force")
    if touch is None or not len(force["stamp_ns"]):
        return None
    since_ns = force["stamp_ns"] - touch["stamp_ns"]
    return float(force["impulse"][(since_ns >= 0) & (since_ns < IMPACT_NS)].sum())


def _steady_force(flight: Flight) -> float | None:
    """Average the contact force in the last 2 s of a mission that succeeded [N].

    A steady force does not depend on the simulator's contact parameters.
    """
    touch = flight.first_touch
    if touch is None or flight.ending is None or flight.ending[1] != "done":
        return None
    begin_ns = flight.ending[0] - PRESSING_NS
    if touch["stamp_ns"] > begin_ns:
        return None
    force = flight.during("/contact_force")
    return mean(force["force"][force["stamp_ns"] >= begin_ns])


def _cross_track(flight: Flight) -> float | None:
    """Compute the RMS distance from the true path to the lines between the waypoints [m].

    The first line begins where the flight does. Each position counts up to the first touch, with
    its distance from the nearest line. None for a mission without waypoints.
    """
    path = flight.truth["position"]
    if touch := flight.first_touch:
        path = path[flight.truth["stamp_ns"] <= touch["stamp_ns"]]
    if not len(path) or not flight.mission.waypoints:
        return None
    corners = np.array([path[0], *(each.position_m for each in flight.mission.waypoints)])
    squares = np.full(len(path), np.inf)  # of the distances [m^2]
    for begin, way in zip(corners, np.diff(corners, axis=0), strict=False):
        since = path - begin
        share = np.clip(since @ way / max(way @ way, np.finfo(float).tiny), 0.0, 1.0)
        np.minimum(squares, np.square(since - np.outer(share, way)).sum(axis=1), out=squares)
    return rms(np.sqrt(squares))


def obstacle_contacts(flight: Flight) -> dict[str, Array]:
    """Select the rows of /contact in which the robot touches an obstacle."""
    contact, touch = flight.during("/contact"), flight.mission.touched
    rows = [is_obstacle(str(body), touch=touch) for body in contact["body"]]
    return select(contact, np.array(rows, dtype=bool))


def _steady_error(flight: Flight, axis: int) -> float | None:
    """Average the distance from setpoint to true position [m] along x, y or z (`axis` 0, 1 or 2).

    None if the flight is shorter than 15 s, or if in its last 15 s the setpoint moved or the probe
    touched something.
    """
    control, force = flight.control, flight.during("/contact_force")
    if flight.end_ns is None or flight.start_ns is None:
        return None
    begin_ns = flight.end_ns - RESTING_NS
    settling_ns = begin_ns - SETTLING_NS
    # In the period in which the mission ends, the setpoint is the place where the robot stays.
    during = (control["stamp_ns"] >= settling_ns) & (control["waypoint"] >= 0)
    still = control["setpoint"][during]
    touched = (force["force"][force["stamp_ns"] >= settling_ns] > 0).any()
    too_short = settling_ns < flight.start_ns
    if too_short or touched or not len(still) or (still != still[-1]).any():
        return None
    rows = flight.truth["stamp_ns"] >= begin_ns
    return mean(np.abs(flight.truth["position"][rows, axis] - still[-1, axis]))


def _fault_count(flight: Flight) -> float | None:
    """Count each fault code once, but a code in `FAILURES` as often as it happened in the flight.

    A fault from before the flight counts, too: it tells of the flight's programs or link.
    """
    found = dict.fromkeys(flight.recording["/fault"]["code"], 1.0)
    for name in FAILURES:
        found[name] = max(found.get(name, 0.0), flight.growth(name) or 0.0)
    return flight.count(sum(found.values()))


def _recorder_dropped(flight: Flight) -> float | None:
    rows = rows_of(flight.recording["/count"], "end", "name", "total")
    last = {end: total for end, name, total in rows if name == "recorder_dropped"}
    return float(sum(last.values())) if last else None


def _rotor_energy(flight: Flight) -> float | None:
    """Return the mechanical energy that the rotors used in the flight [J]; None if not recorded.

    Source: that of `EnergyMeter`. Between two records, about a second, it is taken to rise evenly.
    """
    rows = flight.recording["/energy"]
    if flight.span_ns is None or not len(rows):
        return None
    first_ns, span_ns = rows["stamp_ns"][0], np.array(flight.span_ns)
    begin, end = np.interp(span_ns - first_ns, rows["stamp_ns"] - first_ns, rows["energy"])
    return float(end - begin)


add_measures(
    ("waypoints_reached", _waypoints_reached),
    ("yaw_error", _yaw_error),
    ("final_error", _final_error),
    ("obstacle_contacts", lambda flight: flight.count(len(obstacle_contacts(flight)["body"]))),
    (
        "contact_time",
        lambda flight: flight.first_touch and float(flight.seconds(flight.first_touch["stamp_ns"])),
    ),
    (
        "touch_speed",
        lambda flight: (
            flight.first_touch and float(np.linalg.norm(flight.first_touch["touch_velocity"]))
        ),
    ),
    ("peak_contact_force", _peak_force),
    ("contact_impulse", _impulse),
    ("steady_contact_force", _steady_force),
    *(
        (f"steady_error_{name}", partial(_steady_error, axis=axis))
        for axis, name in enumerate("xyz")
    ),
    ("rotor_energy", _rotor_energy),
    ("cross_track_rms", _cross_track),
    ("hold_count", lambda flight: flight.count(len(holds(flight)))),
    (
        "hold_time",
        lambda flight: flight.count(sum(end - begin for begin, end in holds(flight)) * 1e-9),
    ),
    ("fault_count", _fault_count),
    ("recorder_dropped", _recorder_dropped),
)
