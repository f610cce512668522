"""Faults F27 and F28: a mission that cannot be flown, and a waypoint that is not reached."""

from __future__ import annotations

import re
from math import inf, nan
from typing import Any

import numpy as np

from cloudrc import assembly
from cloudrc.config.mission_check import check_mission
from cloudrc.config.problems import Problem
from cloudrc.config.schema import Mission as MissionSchema
from cloudrc.faults import measures
from cloudrc.faults.flight import Flight
from cloudrc.faults.scenario import Outcome, Scenario
from cloudrc.geometry import fence
from cloudrc.geometry.placement import find_overlapped_pipe
from cloudrc.geometry.scene import Scene, load_scene
from cloudrc.messages import Command, GuardState, Vector
from cloudrc.records import Control


def _impossible(seed: int) -> Outcome:
    outcome, scene = Outcome(), load_scene("pipes")
    wall = _wall_of(scene)
    cases: dict[str, tuple[Any, str]] = {
        "outside the fence": ((100.0, 0.0, 1.0), "nearest legal point"),
        "1 m behind a wall of the fence": ((fence.HIGH[0] + 1.0, 0.0, 1.0), "beyond the fence"),
        "in a pipe's wall": (wall, "overlaps the wall"),
        "far below the floor": ((0.0, 0.0, -5.0), "beyond the fence"),
    }
    for name, (position, word) in cases.items():
        mission = MissionSchema.model_validate(
            {"waypoints": ({"position_m": (0.0, 0.0, 1.0)}, {"position_m": position})}
        )
        problems = check_mission(mission, scene)
        outcome.true(f"{name}: refused, with the reason", word in _text(problems))
        outcome.true(f"{name}: names the waypoint's index", "1" in _paths(problems))
        told = all(f"{value:g}" in problems[0].value for value in position)
        outcome.true(f"{name}: names what was asked for", told)
        outcome.true(f"{name}: offers a point that is legal", _offers_legal(problems[0], scene))
    for name, value in (("NaN", nan), ("infinite", inf), ("a word", "high")):
        outcome.true(f"{name}: refused", _refused({"position_m": (0.0, 0.0, value)}))
    bore, beside = {"position_m": scene.pipes[0].centre}, {"position_m": (0.5, 0.0, 0.8)}
    for way in ((bore, beside), (beside, bore)):
        (problem,) = check_mission(MissionSchema.model_validate({"waypoints": way}), scene)
        outcome.true("behind a wall: its index is named", problem.path[1] == "1")
        outcome.true("behind a wall: the wall is named", scene.pipes[0].name in problem.reason)
    outcome.true("none at all: refused", bool(check_mission(MissionSchema(), scene)))
    many = {"waypoints": ({"position_m": (0.0, 0.0, 1.0)},) * 10_001}
    outcome.true("10,001 waypoints: refused", _refuses(many))
    return outcome


def _offers_legal(problem: Problem, scene: Scene) -> bool:
    """Tell whether a refusal names another point, which is not refused."""
    found = re.search(r"nearest legal point found: \[(.*)\]", problem.reason)
    if found is None:
        return False
    point = tuple(float(each) for each in found[1].split(", "))
    offered = MissionSchema.model_validate({"waypoints": ({"position_m": point},)})
    return not check_mission(offered, scene)


def _wall_of(scene: Scene) -> Vector:
    """Return a point in the wall of a pipe."""
    for y in np.linspace(-8.0, 5.0, 131):
        for z in np.linspace(0.3, 2.4, 22):
            points = np.array([[x, y, z] for x in np.linspace(-2.5, 9.0, 116)])
            hits = np.flatnonzero(find_overlapped_pipe(scene, points, np.zeros(len(points))) >= 0)
            if len(hits):
                x, y, z = points[hits[0]].tolist()
                return (x, y, z)
    raise AssertionError("the scene has no pipe")


def _text(problems: list[Problem]) -> str:
    return " ".join(map(str, problems))


def _paths(problems: list[Problem]) -> set[str]:
    return {part for problem in problems for part in problem.path}


def _refused(waypoint: dict[str, Any]) -> bool:
    return _refuses({"waypoints": (waypoint,)})


def _refuses(document: dict[str, Any]) -> bool:
    try:
        MissionSchema.model_validate(document)
    except ValueError:
        return True
    return False


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
