"""Faults F27 and F28: a mission that cannot be flown, and a waypoint that is not reached."""

from __future__ import annotations

import re
from math import inf, nan
from typing import Any

from cloudrc import assembly
from cloudrc.config.mission_check import check_mission
from cloudrc.config.schema import Mission as MissionSchema
from cloudrc.faults import measures
from cloudrc.faults.flight import Flight
from cloudrc.faults.scenario import Outcome, Scenario
from cloudrc.geometry import fence
from cloudrc.geometry.scene import Pipe, Scene, load_scene
from cloudrc.messages import Command, GuardState, Vector
from cloudrc.records import Control


def _impossible(seed: int) -> Outcome:
    outcome, scene, first = Outcome(), load_scene("pipes"), (0.5, 0.0, 0.8)
    points: dict[str, Vector] = {
        "outside the fence": (100.0, 0.0, 1.0),
        "1 m behind a wall of the fence": (fence.HIGH[0] + 1.0, 0.0, 1.0),
        "far below the floor": (0.0, 0.0, -5.0),
        "in a pipe's wall": _wall_of(scene.pipes[0]),
    }
    for name, point in points.items():
        problems = _problems([first, point], scene)
        outcome.true(f"{name}: refused", bool(problems))
        told = bool(problems) and "1" in problems[0].path
        told = told and all(f"{value:g}" in problems[0].value for value in point)
        outcome.true(f"{name}: names the waypoint's index and value", told)
        offer = re.search(r"nearest legal point found: \[([^\]]*)\]", " ".join(map(str, problems)))
        offered = [tuple(map(float, offer[1].split(", ")))] if offer else []
        ways = [offered, [first, *offered]]  # a straight way to it may lead through a wall
        legal = bool(offered) and not all(_problems(way, scene) for way in ways)
        outcome.true(f"{name}: offers another point, which is legal", legal)
    bore = scene.pipes[0].centre
    others: dict[str, list[Any]] = {
        "NaN": [(0.0, 0.0, nan)],
        "infinite": [(0.0, 0.0, inf)],
        "a word": [(0.0, 0.0, "high")],
        "behind a wall": [bore, first],
        "none at all": [],
        "10,001 waypoints": [first] * 10_001,
    }
    for name, way in others.items():
        outcome.true(f"{name}: refused", bool(_problems(way, scene)))
    return outcome


def _problems(way: list[Any], scene: Scene) -> list[Any]:
    """Return why a mission with these waypoints [m] is refused; nothing if it is not."""
    try:
        waypoints = tuple({"position_m": point} for point in way)
        mission = MissionSchema.model_validate({"waypoints": waypoints})
    except ValueError as error:
        return [error]
    return list(check_mission(mission, scene))


def _wall_of(pipe: Pipe) -> Vector:
    """Return a point in the wall of a horizontal pipe, beside its middle."""
    (x, y, z), (ax, ay, _), radius = pipe.centre, pipe.axis, 0.5 * (pipe.inner + pipe.outer)
    return (x - ay * radius, y + ax * radius, z)


def _unreachable(seed: int) -> Outcome:
    """Command the robot to stay where it is."""
    outcome, at, stays = Outcome(), measures.instant(seed, 12.0, 20.0), list[Vector]()

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
    leg = assembly.build_plan(flight.experiment).legs[len(reached)]
    began = reached[-1].stamp_ns * 1e-9
    outcome.most("the leg ends off its limit by", abs(ended - began - leg.time_limit), 0.05, "s")
    measures.moves(outcome, flight, "teleop", "missions_total", "leg_timed_out", since=ended - 0.01)
    flight.fly(flight.now + 10.0)
    outcome.true("the robot holds", flight.guard_now()[0] is GuardState.HOLD)
    outcome.most(
        "drift from where the leg ended", measures.drift(flight, ended, flight.now), 0.10, "m"
    )
    return outcome


SCENARIOS = (
    Scenario(
        27,
        "impossible-mission",
        "waypoints of NaN, in a wall, behind one, beyond the fence, 10,001 of them",
        "refused as a whole, before anything is flown",
        "nothing",
        "index, value, reason and the nearest legal point; no metric, nothing was ordered",
        _impossible,
    ),
    Scenario(
        28,
        "waypoint-not-reached",
        "what the cloud commands comes to nothing",
        "HOLD; the leg ends by its limit of time",
        "that leg",
        "mission failed: leg_timed_out, with the waypoint; cloudrc_missions_total",
        _unreachable,
    ),
)
