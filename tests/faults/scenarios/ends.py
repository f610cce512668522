# SPDX-License-Identifier: Apache-2.0

"""Faults F13, F15, F17, F23, F25, F27, F28 and F40: faults of processes, commands and missions."""

from __future__ import annotations

from math import hypot, inf, nan
from typing import Any

import numpy as np

from cloudrc.config.load import read_experiment
from cloudrc.config.mission_check import check_mission
from cloudrc.config.schema import MissionConfig
from cloudrc.flight.assembly.plan import build_plan
from cloudrc.physics.geometry.obstacles import fence_of
from cloudrc.physics.geometry.scene import Tube
from cloudrc.wire.messages import Command, GuardState, Vector
from cloudrc.wire.records import CommandApplied, Control, Fault, GroundTruth
from cloudrc.wire.tunnel.handshake import BUSY_TEXT
from tests.faults.adversary import Lie
from tests.faults.measures import (
    AGE_MAX,
    Outcome,
    changes_into,
    drift,
    epochs,
    events_of_missions,
    first_into,
    scenario,
    told,
)
from tests.faults.schedule import FaultEvent, Way, generator

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
    13,
    "cloud-killed",
    injects="SIGKILL of the cloud process; a new process starts 0.8 s later",
    expects="HOLD within 252 ms; new commands in <= 2 s; the mission continues at its waypoint",
)
def _cloud_killed(outcome: Outcome) -> None:
    at, down = outcome.instant(), 0.8
    flight = outcome.fly(events=(FaultEvent("cloud_killed", at, down),))
    outcome.held_in_time(flight)
    commands = [r.stamp_ns * 1e-9 - at for r in flight.of(CommandApplied)]
    again = min((t for t in commands if t > down), default=nan)
    outcome.most("the new process commands after", again, 2.0, "s")
    back = at + down
    tracked = first_into(flight, GuardState.TRACK, back) - back
    outcome.most("TRACK again after its start", tracked, 1.0, "s")
    outcome.least("epochs opened", len(epochs(flight)), 3)


@scenario(
    15,
    "cloud-paused",
    injects="SIGSTOP of the cloud process for 5 s",
    expects="HOLD; world applies no command that is too old",
)
def _cloud_paused(outcome: Outcome) -> None:
    paused = FaultEvent("cloud_paused", outcome.instant(), 5.0)
    flight = outcome.fly(events=(paused,))
    outcome.held_in_time(flight)
    old = [r for r in flight.of(CommandApplied) if r.stamp_ns - r.basis_stamp_ns > AGE_MAX * 1e9]
    outcome.same("commands applied that were too old", len(old), 0)


@scenario(
    17,
    "world-restarted",
    injects="the world pod restarts within 2 s",
    expects="the robot is at its spawn on the ground, and stays there; a new epoch; world rejects "
    "commands of the old epoch",
)
def _world_restarted(outcome: Outcome) -> None:
    at = outcome.instant()
    flight = outcome.prepare(events=(FaultEvent("world_killed", at, 2.0),))
    flight.fly(at + 12.0)
    outcome.safe(flight)
    after = [c for c in flight.changes if c.stamp_ns * 1e-9 > at]
    outcome.same("changes of the guard after the restart", len(after), 0)
    path = [r for r in flight.of(GroundTruth) if r.stamp_ns * 1e-9 > at]
    moved = max((hypot(*r.odometry.velocity) for r in path), default=nan)
    outcome.most("speed on the ground", moved, 0.01, "m/s")
    raised = drift(flight, at, flight.now)
    outcome.most("distance from its place after the restart", raised, 0.01, "m")
    outcome.true("mission failed", flight.mission.state == "failed")
    outcome.true("with the code world_restarted", "world_restarted" in str(flight.mission.verdict))
    outcome.rejected(flight, "old_epoch")  # commands for the old world


@scenario(
    25,
    "two-clouds",
    injects="a second cloud with the same key; later the first one leaves",
    expects="the first cloud keeps the session until it leaves; then HOLD, and the second cloud "
    "gets a higher epoch; commands of both never mix",
)
def _two_clouds(outcome: Outcome) -> None:
    at = outcome.instant(4.0, 12.0)
    flight = outcome.prepare(events=(FaultEvent("second_cloud", at, 60.0),))
    flight.fly(at + 5.0)
    outcome.same("epochs while both clouds run", max(epochs(flight), default=-1), 2)
    flight.fly(at + 6.0)
    outcome.no_hold(flight, "HOLDs while both clouds run")
    faults = [record for record in flight.of_cloud if isinstance(record, Fault)]
    outcome.same("faults that the first cloud reports", len(faults), 0)
    flight.end_cloud(0)
    flight.fly(at + 14.0)
    outcome.safe(flight)
    outcome.rejected(flight, "busy")
    busy = told(flight.others, "busy")
    outcome.true("the second reports once why it waits", [r.text for r in busy] == [BUSY_TEXT])
    said = min((r.stamp_ns * 1e-9 for r in busy), default=nan)
    outcome.most("the second cloud reports it after", said - at, 1.0, "s")
    outcome.held_in_time(flight, "HOLD after the first cloud has left")
    later = [epoch for epoch in epochs(flight) if epoch > 2]
    outcome.true("the second cloud then gets a higher epoch", bool(later))


@scenario(
    40,
    "swizzle-clog",
    injects="uplink, downlink, cloud, world and teleop freeze one by one and return in random "
    "order",
    expects="always a safe state; the mission continues",
)
def _swizzle(outcome: Outcome) -> None:
    """Block both directions of the link, then stop the processes; resume all in random order.

    Source: FoundationDB, "Simulation and Testing", swizzle-clogging.
    """
    rng = generator(outcome.seed, 40)
    starts = outcome.instant() + np.cumsum(rng.uniform(0.1, 1.0, 5))
    ends = rng.permutation(starts[-1] + np.cumsum(rng.uniform(0.1, 1.5, 5)))
    spans = zip(starts.tolist(), (ends - starts).tolist(), strict=True)
    ways: tuple[Way, ...] = ("up", "down", "both", "both", "both")
    kinds = ("blackout", "blackout", "cloud_paused", "world_paused", "teleop_killed")
    faults = zip(kinds, spans, ways, strict=True)
    events = tuple(FaultEvent(kind, *span, way=way) for kind, span, way in faults)
    flight = outcome.fly("criteria.time_limit_s=120", events=events)
    outcome.held_in_time(flight)
    for end, records in (("cloud", flight.of_cloud), ("world", flight.of_world)):
        outcome.least(f"times that {end} reports: late", len(told(records, "late")), 1)
    restarted = events_of_missions(flight, "restarted")
    outcome.least("events restarted in teleop's log", len(restarted), 1)


@scenario(
    23,
    "invalid-values",
    injects="NaN, infinite, huge and excessive values in authentic commands",
    expects="rejected or limited; 5 rejected commands in 1 s cause LAND until acknowledged",
)
def _invalid_values(outcome: Outcome) -> None:
    at = outcome.instant()
    for name, changes in IMPOSSIBLE.items():
        flight = outcome.prepare(lies=[_for_a_while(at, 1.0, changes)]).fly(40.0)
        outcome.safe(flight)
        landed = first_into(flight, GuardState.LAND)
        outcome.most(f"{name}: LAND after", landed - at, 1.0, "s")
        tracked = changes_into(flight, GuardState.TRACK)
        again = [change for change in tracked if change.stamp_ns * 1e-9 > landed]
        outcome.same(f"{name}: flown again without the operator", len(again), 0)
        causes = [change.cause for change in changes_into(flight, GuardState.LAND)]
        outcome.true(f"{name}: the cause is reported", "impossible commands" in " ".join(causes))
        outcome.rejected(flight, "range")
    for limit, changes in EXCESSIVE.items():
        flight = outcome.prepare(lies=[_for_a_while(at, 1.0, changes)]).fly(40.0)
        outcome.safe(flight, "collision" if limit == "speed" else "")  # it may hit a tube
        impossible = sum("impossible" in change.cause for change in flight.changes)
        outcome.same(f"100 times {limit}: rejected as impossible", impossible, 0)
        outcome.least(f"100 times {limit}: limited", flight.count(f"limited_{limit}"), 20)
    one = outcome.prepare(lies=[_for_a_while(at, 0.005, IMPOSSIBLE["NaN"])]).fly(40.0)
    outcome.safe(one)
    outcome.done(one)
    outcome.same("a single NaN: LAND", len(changes_into(one, GuardState.LAND)), 0)


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
    expects="the whole mission is rejected before the flight",
)
def _impossible(outcome: Outcome) -> None:
    experiment, first = read_experiment("paper"), (0.5, 0.0, 0.8)
    scene = experiment.scene
    points: dict[str, Vector] = {
        "1 m behind a wall of the fence": (fence_of(scene).high[0] + 1.0, 0.0, 1.0),
        "far below the floor": (0.0, 0.0, -5.0),
        "in the wall of a tube": _wall_of(scene.tubes[0]),
    }
    others: dict[str, list[Any]] = {
        "NaN": [(0.0, 0.0, nan)],
        "a word": [(0.0, 0.0, "high")],
        "behind a wall": [scene.tubes[0].centre, first],
        "none at all": [],
        "10,001 waypoints": [first] * 10_001,
    }
    for name, way in ({name: [first, point] for name, point in points.items()} | others).items():
        try:
            waypoints = tuple({"position_m": point} for point in way)
            mission = MissionConfig.model_validate(
                {"waypoints": waypoints, "touch": experiment.mission.touch}
            )
            problems = [str(each) for each in check_mission(mission, experiment.world.files)]
        except ValueError as error:
            problems = [str(error)]
        outcome.true(f"{name}: rejected", bool(problems))
        if name in points:
            values = (f"{value:g}" in problems[0] for value in points[name])
            told = "waypoints.1" in problems[0] and all(values)
            outcome.true(f"{name}: names the waypoint's index and value", told)


def _wall_of(tube: Tube) -> Vector:
    """Return a point inside the wall of a horizontal tube, at half of its length."""
    (x, y, z), (ax, ay, _), radius = tube.centre, tube.axis, 0.5 * (tube.inner + tube.outer)
    return (x - ay * radius, y + ax * radius, z)


@scenario(
    28,
    "waypoint-not-reached",
    injects="cloud commands the robot to stay where it is",
    expects="the leg ends at its time limit, and HOLD begins",
)
def _unreachable(outcome: Outcome) -> None:
    at, stays = outcome.instant(12.0, 20.0), list[Vector]()

    def stalled(command: Command, control: Control) -> Command:
        if control.stamp_ns * 1e-9 < at:
            return command
        stays.append(control.measured)
        x, y, z = (a - b for a, b in zip(stays[0], control.measured, strict=True))
        return command._replace(velocity=(x, y, z))

    flight = outcome.prepare("criteria.time_limit_s=300", lies=[stalled])
    flight.fly_mission(200.0)
    outcome.safe(flight)
    outcome.true("the mission ends", flight.mission.state == "failed")
    verdict = str(flight.mission.verdict)
    outcome.true("with the code leg_timed_out", "leg_timed_out" in verdict)
    outcome.true("it says which waypoint", "waypoint" in verdict and "not reached" in verdict)
    ended = max(event.stamp_ns for event in flight.events("leg_timed_out")) * 1e-9
    reached = flight.events("reached")
    leg, began = build_plan(flight.experiment).legs[len(reached)], reached[-1].stamp_ns
    off = abs(ended - began * 1e-9 - leg.time_limit)
    outcome.most("deviation of the leg's end from its limit", off, 0.05, "s")
    flight.fly(flight.now + 10.0)
    outcome.true("the robot holds", flight.guard_now()[0] is GuardState.HOLD)
    outcome.most("drift from where the leg ended", drift(flight, ended, flight.now), 0.10, "m")
