"""Faults of missions: impossible ones, rivals, orders that come twice, points out of reach."""

from __future__ import annotations

import re
from collections import Counter
from math import inf, nan
from typing import Any

import numpy as np

from cloudrc import assembly
from cloudrc.config.mission_check import check_mission
from cloudrc.config.problems import Problem
from cloudrc.config.schema import Mission as MissionSchema
from cloudrc.faults import asks, toll
from cloudrc.faults import asks as meters
from cloudrc.faults.adversary import tempting
from cloudrc.faults.flight import Flight
from cloudrc.faults.scenario import Outcome, Scenario, generator
from cloudrc.faults.scenarios.link import instant
from cloudrc.geometry import fence
from cloudrc.geometry.placement import find_overlapped_pipe
from cloudrc.geometry.scene import Scene, load_scene
from cloudrc.messages import Command, GuardState, Vector
from cloudrc.records import Control
from cloudrc.teleop.models import read_mission
from cloudrc.teleop.store import ConflictError, Order

NEARER = 0.05
"""What the search for the nearest legal point, along some lines, may overlook [m]."""
LOOKED_AT = 2_000


def _impossible(seed: int) -> Outcome:
    outcome, scene = Outcome(), load_scene("pipes")
    wall = _wall_of(scene)
    cases: dict[str, tuple[Any, str]] = {
        "outside the fence": ((100.0, 0.0, 1.0), "nearest legal point"),
        "1 m behind a wall of the fence": ((fence.HIGH[0] + 1.0, 0.0, 1.0), "beyond the fence"),
        "in a pipe's wall": (wall, "of the wall of"),
        "far below the floor": ((0.0, 0.0, -5.0), "beyond the fence"),
    }
    for name, (position, word) in cases.items():
        mission = MissionSchema.model_validate(
            {"waypoints": ({"position_m": (0.5, 0.0, 1.0)}, {"position_m": position})}
        )
        problems = check_mission(mission, scene)
        outcome.true(f"{name}: refused, with the reason", word in _text(problems))
        outcome.true(f"{name}: names the waypoint's index", "1" in _paths(problems))
        told = all(f"{value:g}" in problems[0].value for value in position)
        outcome.true(f"{name}: names what was asked for", told)
        _judge_way_out(outcome, name, problems[0], scene, position)
    for name, value in (("NaN", nan), ("infinite", inf), ("a word", "high")):
        outcome.true(f"{name}: refused", _refused({"position_m": (0.0, 0.0, value)}))
    bore, beside = {"position_m": scene.pipes[0].centre}, {"position_m": (0.5, 0.0, 0.8)}
    for way in ((bore, beside), (beside, bore)):
        there = MissionSchema.model_validate({"start": "here", "waypoints": way})
        (problem,) = check_mission(there, scene)
        outcome.true("behind a wall: its index is named", problem.path[1] == "1")
        outcome.true("behind a wall: the wall is named", scene.pipes[0].name in problem.reason)
    outcome.true("none at all: refused", bool(check_mission(MissionSchema(), scene)))
    many = {"waypoints": ({"position_m": (0.0, 0.0, 1.0)},) * 10_001}
    outcome.true("10,001 waypoints: refused", _refuses(many))
    body = b'{"waypoints": [{"position_m": [100, 0, 1]}]}'
    refused = toll.ordered(lambda: read_mission(body, scene))["order_invalid"]
    meters.counts(
        outcome, "teleop", "api_order_invalid", refused, "missions_refused_total", "invalid"
    )
    return outcome


def _judge_way_out(
    outcome: Outcome, name: str, problem: Problem, scene: Scene, position: Vector
) -> None:
    """Check that the point which is offered instead can be flown to, and that none is nearer."""
    found = re.search(r"nearest legal point found: \[(.*)\]", problem.reason)
    outcome.true(f"{name}: names the nearest legal point", found is not None)
    if found is None:
        return
    near = np.array([float(each) for each in found[1].split(", ")])
    offered = {"start": "here", "waypoints": ({"position_m": tuple(near.tolist())},)}
    legal = not check_mission(MissionSchema.model_validate(offered), scene)
    outcome.true(f"{name}: it is legal", legal)
    start = np.clip(position, fence.INNER_LOW, fence.INNER_HIGH)
    rng = generator(27, 0)
    reach = float(np.linalg.norm(near - start)) - NEARER
    around = rng.normal(size=(LOOKED_AT, 3))
    around *= rng.uniform(0.0, max(reach, 0.0), (LOOKED_AT, 1)) / np.linalg.norm(
        around, axis=1, keepdims=True
    )
    points = np.clip(start + around, fence.INNER_LOW, fence.INNER_HIGH)
    nearer = (find_overlapped_pipe(scene, points, np.zeros(LOOKED_AT)) < 0) & (reach > 0.0)
    outcome.same(f"{name}: legal points nearer than it by more than 5 cm", int(nearer.sum()), 0)


def _wall_of(scene: Scene) -> tuple[float, float, float]:
    """A point in the wall of a pipe: what the check itself finds."""
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
    """The robot cannot get on: what it is told to fly comes to nothing."""
    outcome, at, stays = Outcome(), instant(seed, 12.0, 20.0), list[Vector]()

    def stalled(command: Command, control: Control) -> Command:
        if control.stamp_ns * 1e-9 < at:
            return command
        stays.append(control.measured)
        x, y, z = (a - b for a, b in zip(stays[0], control.measured, strict=True))
        return command._replace(velocity=(x, y, z))

    tempt = tempting(stalled)
    flight = Flight("criteria.time_limit_s=300", seed=seed, tempt=tempt)
    flight.fly_mission(200.0)
    asks.safe(outcome, flight)
    outcome.true("the mission ends", flight.mission.state == "failed")
    verdict = str(flight.mission.verdict)
    outcome.true("with the code leg_timed_out", "leg_timed_out" in verdict)
    outcome.true("it says which waypoint", "waypoint" in verdict and "not reached" in verdict)
    ended = max(event.stamp_ns for event in flight.events("leg_timed_out")) * 1e-9
    reached = flight.events("reached")
    leg = assembly.build_plan(flight.experiment).legs[len(reached)]
    began = reached[-1].stamp_ns * 1e-9
    outcome.most("the leg ends off its limit by", abs(ended - began - leg.time_limit), 0.05, "s")
    meters.moves(outcome, flight, "teleop", "missions_total", "leg_timed_out", since=ended - 0.01)
    flight.fly(flight.now + 10.0)
    outcome.true("the robot holds", flight.state_at(flight.run.now_ns) is GuardState.HOLD)
    outcome.most("drift from where the leg ended", asks.drift(flight, ended, flight.now), 0.10, "m")
    return outcome


def _rival_mission(seed: int) -> Outcome:
    outcome, at, named = Outcome(), instant(seed), [""]
    clean, flight = Flight(seed=seed).fly_mission(), Flight(seed=seed)
    refused = Counter[str]()

    def order(now_ns: int) -> None:
        try:
            flight.order(now_ns)
        except ConflictError as error:
            named[0] = error.mission
            raise

    flight.cloud.at(at, lambda now_ns: refused.update(toll.ordered(lambda: order(now_ns))))
    flight.fly_mission()
    asks.safe(outcome, flight)
    asks.done(outcome, flight)
    outcome.true("the second is refused, naming the first", named[0] == flight.mission.id)
    total = refused["order_conflict"]
    meters.counts(
        outcome, "teleop", "api_order_conflict", total, "missions_refused_total", "conflict"
    )
    outcome.true("the same path, bit by bit", asks.same_path(clean, flight))
    return outcome


def _twice(seed: int) -> Outcome:
    """Four pods of one Job; each goes by the mission that it was answered with."""
    outcome, at = Outcome(), instant(seed)
    flight, answers = Flight(seed=seed, start=False), list[tuple[str, bool]]()
    service, plan = flight.desk.service, assembly.build_plan(flight.experiment)
    assert service is not None

    def post(now_ns: int) -> None:
        mission, new = service.create(Order(plan, key="job-1", queue=True), now_ns)
        answers.append((mission.id, new))

    for time in (0.1, 0.1, at, at + 1.0):
        flight.cloud.at(time, post)
    flight.fly(1.0).fly_mission()
    asks.safe(outcome, flight)
    asks.done(outcome, flight)
    outcome.same("missions made by 4 orders under one key", sum(new for _, new in answers), 1)
    outcome.same("missions in the journal", len(flight.desk.missions), 1)
    outcome.same("missions that were begun", len(flight.events("started")), 1)
    ends = [service.book.find(mission).state for mission, _ in answers]
    outcome.same("orders that end with done", ends.count("done"), 4)
    outcome.same("missions that they were answered with", len({each for each, _ in answers}), 1)
    return outcome


SCENARIOS = (
    Scenario(
        27,
        "impossible-mission",
        "waypoints of NaN, in a wall, behind one, beyond the fence, 10,001 of them",
        "refused as a whole, before anything is flown",
        "nothing",
        "index, value, reason and the nearest legal point; cloudrc_missions_refused_total",
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
    Scenario(
        34,
        "second-mission",
        "another mission is ordered while one is flown",
        "refused with the id of the one under way, which flies the same path, bit by bit",
        "none",
        "409 with the mission's id; cloudrc_missions_refused_total",
        _rival_mission,
    ),
    Scenario(
        35,
        "job-twice",
        "the same order under the same key, four times",
        "one mission, flown once; all four report its end",
        "none",
        "the same mission; no metric",
        _twice,
    ),
)
