"""Faults F23, F27 and F28: impossible commands, impossible missions, a waypoint out of reach."""

from __future__ import annotations

from math import inf, nan
from typing import Any

from cloudrc import assembly
from cloudrc.config.mission_check import check_mission
from cloudrc.config.schema import Mission
from cloudrc.faults import measures
from cloudrc.faults.adversary import Lie
from cloudrc.faults.flight import Flight
from cloudrc.faults.scenario import Outcome, scenario
from cloudrc.geometry import fence
from cloudrc.geometry.scene import Pipe, load_scene
from cloudrc.messages import Command, GuardState, Vector
from cloudrc.records import Control

IMPOSSIBLE: dict[str, dict[str, Any]] = {
    "NaN": {"velocity": (nan, 0.0, 0.0)},
    "yaw infinite": {"yaw_rate": inf},
    "1e308": {"velocity": (1e308, -1e308, 1e308)},
}
EXCESSIVE: dict[str, dict[str, Any]] = {
    "speed": {"velocity": (100.0, 0.0, 0.0)},
    "yaw_rate": {"yaw_rate": 100.0},
}
"""Limit of the guard -> command that exceeds the limit."""


@scenario(
    23,
    "invalid-values",
    injects="NaN, infinite, huge and excessive values in authentic commands",
    expects="rejected or limited; 5 rejected commands in 1 s cause LAND until acknowledged",
)
def _invalid_values(outcome: Outcome, seed: int) -> None:
    at = measures.instant(seed)
    for name, changes in IMPOSSIBLE.items():
        flight = Flight(seed=seed, lies=[_for_a_while(at, 1.0, changes)]).fly(40.0)
        measures.safe(outcome, flight)
        landed = measures.first_into(flight, GuardState.LAND)
        outcome.most(f"{name}: LAND after", landed - at, 1.0, "s")
        tracked = measures.changes_into(flight, GuardState.TRACK)
        again = [change for change in tracked if change.stamp_ns * 1e-9 > landed]
        outcome.same(f"{name}: flown again without the operator", len(again), 0)
        causes = [change.cause for change in measures.changes_into(flight, GuardState.LAND)]
        outcome.true(f"{name}: the cause is reported", "impossible commands" in " ".join(causes))
        measures.refused(outcome, flight, "range")
    for limit, changes in EXCESSIVE.items():
        lie, harmless = _for_a_while(at, 1.0, changes), limit != "speed"  # it may hit a pipe
        flight = Flight(seed=seed, honest=harmless, lies=[lie]).fly(40.0)
        measures.safe(outcome, flight)
        refused = sum("impossible" in change.cause for change in flight.changes)
        outcome.same(f"100 times {limit}: rejected as impossible", refused, 0)
        outcome.least(f"100 times {limit}: limited", flight.count(f"limited_{limit}"), 20)
    one = Flight(seed=seed, lies=[_for_a_while(at, 0.005, IMPOSSIBLE["NaN"])]).fly(40.0)
    measures.safe(outcome, one)
    measures.done(outcome, one)
    outcome.same("a single NaN: LAND", len(measures.changes_into(one, GuardState.LAND)), 0)


def _for_a_while(at: float, duration: float, changes: dict[str, Any]) -> Lie:
    """Return a function that applies `changes` to commands from `at` [s] on, for `duration` [s]."""

    def lie(command: Command, control: Control) -> Command:
        now = control.stamp_ns * 1e-9
        return command._replace(**changes) if at <= now < at + duration else command

    return lie


@scenario(
    27,
    "impossible-mission",
    injects="waypoints of NaN, in a wall, behind a wall, beyond the fence; 10,001 waypoints",
    expects="the whole mission is refused before the flight",
)
def _impossible(outcome: Outcome, seed: int) -> None:
    scene, first = load_scene("pipes"), (0.5, 0.0, 0.8)
    points: dict[str, Vector] = {
        "1 m behind a wall of the fence": (fence.HIGH[0] + 1.0, 0.0, 1.0),
        "far below the floor": (0.0, 0.0, -5.0),
        "in a pipe's wall": _wall_of(scene.pipes[0]),
    }
    others: dict[str, list[Any]] = {
        "NaN": [(0.0, 0.0, nan)],
        "a word": [(0.0, 0.0, "high")],
        "behind a wall": [scene.pipes[0].centre, first],
        "none at all": [],
        "10,001 waypoints": [first] * 10_001,
    }
    for name, way in ({name: [first, point] for name, point in points.items()} | others).items():
        try:
            waypoints = tuple({"position_m": point} for point in way)
            mission = Mission.model_validate({"waypoints": waypoints})
            problems = [str(each) for each in check_mission(mission, scene)]
        except ValueError as error:
            problems = [str(error)]
        outcome.true(f"{name}: refused", bool(problems))
        if name in points:
            values = (f"{value:g}" in problems[0] for value in points[name])
            told = "waypoints.1" in problems[0] and all(values)
            outcome.true(f"{name}: names the waypoint's index and value", told)
            offered = "nearest legal point found: [" in problems[0]
            outcome.true(f"{name}: offers another point", offered)


def _wall_of(pipe: Pipe) -> Vector:
    """Return a point inside the wall of a horizontal pipe, at half of its length."""
    (x, y, z), (ax, ay, _), radius = pipe.centre, pipe.axis, 0.5 * (pipe.inner + pipe.outer)
    return (x - ay * radius, y + ax * radius, z)


@scenario(
    28,
    "waypoint-not-reached",
    injects="cloud commands the robot to stay where it is",
    expects="the leg ends at its time limit, and HOLD begins",
)
def _unreachable(outcome: Outcome, seed: int) -> None:
    at, stays = measures.instant(seed, 12.0, 20.0), list[Vector]()

    def stalled(command: Command, control: Control) -> Command:
        if control.stamp_ns * 1e-9 < at:
            return command
        stays.append(control.measured)
        x, y, z = (a - b for a, b in zip(stays[0], control.measured, strict=True))
        return command._replace(velocity=(x, y, z))

    flight = Flight("criteria.time_limit_s=300", seed=seed, lies=[stalled])
    flight.fly_mission(200.0)
    measures.safe(outcome, flight)
    outcome.true("the mission ends", flight.mission.state == "failed")
    verdict = str(flight.mission.verdict)
    outcome.true("with the code leg_timed_out", "leg_timed_out" in verdict)
    outcome.true("it says which waypoint", "waypoint" in verdict and "not reached" in verdict)
    ended = max(event.stamp_ns for event in flight.events("leg_timed_out")) * 1e-9
    reached = flight.events("reached")
    leg, began = assembly.build_plan(flight.experiment).legs[len(reached)], reached[-1].stamp_ns
    off = abs(ended - began * 1e-9 - leg.time_limit)
    outcome.most("deviation of the leg's end from its limit", off, 0.05, "s")
    flight.fly(flight.now + 10.0)
    outcome.true("the robot holds", flight.guard_now()[0] is GuardState.HOLD)
    drift = measures.drift(flight, ended, flight.now)
    outcome.most("drift from where the leg ended", drift, 0.10, "m")
