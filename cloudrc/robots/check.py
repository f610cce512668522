# SPDX-License-Identifier: Apache-2.0

"""Check a robot: read its facts from the compiled model, and move it in virtual time.

The robot moves without a network, a cloud and a guard: it stands or hovers, follows a step of the
velocity, brakes, and turns: if its heading is free, at a yaw rate; if its heading follows its
velocity, towards a velocity to its left.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from math import atan2, cos, dist, hypot, remainder, sin, tau
from typing import Any

import numpy as np

from cloudrc.base.outside.code import calling
from cloudrc.base.text import table
from cloudrc.config.hull import doubts
from cloudrc.config.overrides import onboard_values
from cloudrc.config.problems import ConfigProblem, collect
from cloudrc.config.resolved import ResolvedGuard
from cloudrc.config.robot import RobotFiles
from cloudrc.config.world import ResolvedWorld
from cloudrc.physics.geometry.vectors import step_towards
from cloudrc.physics.sim.airframe import read_turns, thrust_to_weight
from cloudrc.physics.sim.bodies import reach_of
from cloudrc.physics.sim.scene import ROBOT_PREFIX
from cloudrc.robots.build import advise, build_robot, check_robot
from cloudrc.wire.messages import ZERO, Vector
from cloudrc.world.guard.limits import REACTION
from cloudrc.world.robot import STEP, Robot

SCENE = "empty"
"""Scene of the check."""
CLIMB, RISE = 0.5, 2.0
"""Speed [m/s] and duration [s] of the climb after the start."""
STEADY, FAST, STOP = 3.0, 3.0, 4.0
"""Durations of hovering or standing, of the step, and of braking [s]."""
SPEED = 2.0
"""Largest speed of the step [m/s]."""
DRIFT_MAX = 0.2
"""Largest distance from its place of a robot that hovers or stands [m]."""
SHORT = 0.2
"""Largest part of the step or of the turn that may be missing at its end [1]."""
TURN, TURNING = 0.5, 3.0
"""Yaw rate [rad/s] and duration [s] of the turn of a robot that obeys a yaw."""
REST = 0.1
"""Largest speed at the end of braking [m/s]."""
BRAKING_MAX = 10.0
"""Largest deceleration that the check tells [m/s^2]: guard.braking_mps2 is not larger."""
UPRIGHT_MIN = 0.2
"""Smallest cosine of the tilt of a robot that has not turned over [1]."""


def check(name: str) -> tuple[dict[str, Any], list[str]]:
    """Return the facts about a robot, and what must change, one line each.

    Args:
        name: Name of a shipped robot, or absolute path of a folder or an .xml file.
    """
    world = ResolvedWorld.model_validate({"robot": name, "scene": SCENE})
    robot = world.files.robot
    _ = world.files.hull  # it can be read
    advise(world, ZERO)
    body = build_robot(world, ResolvedGuard.model_validate({}))
    facts = read_facts(world, body.simulator.model)
    changes, failures = [*doubts(name, robot)], list[ConfigProblem]()
    for tuning in robot.tunings:  # an experiment may choose it
        with collect(failures, ()):
            check_robot(world.model_copy(update={"tuning": tuning}))
    motion, rest = dict[str, float](), 0.0
    with collect(failures, ()), calling(f"the onboard controller of {name} failed"):
        motion, rest = _move(body, robot)
    facts |= motion
    changes += map(str, failures)
    if not motion:
        return facts, changes
    if body.simulator.bad_values():
        return facts, [*changes, "the simulation diverged: check masses and inertias of the model"]
    return facts, [*changes, *_judge(robot, facts, rest)]


def read_facts(world: ResolvedWorld, model: Any) -> dict[str, Any]:
    """Return the facts that need no motion."""
    robot = world.files.robot
    base = model.jnt_bodyid[0]
    ratio = thrust_to_weight(model) if not robot.planar else None
    turns = read_turns(model)
    size = reach_of(robot.model)
    return {
        "model": str(robot.model),
        "mass_kg": float(model.body_subtreemass[base]),
        "actuators": [
            model.actuator(n).name.removeprefix(ROBOT_PREFIX) or str(n) for n in range(model.nu)
        ],
        **({"rotors_turn": turns} if turns else {}),
        **({} if ratio is None else {"thrust_to_weight": ratio, "hover_thrust": 1.0 / ratio}),
        "planar": robot.planar,
        "heading": robot.heading,
        "onboard": robot.onboard.name,
        "parameters": onboard_values(robot, world),
        "guard": robot.guard.model_dump(),
        "size_m": size,
        "hull_m": robot.hull_m or size,
        "has_response": robot.response is not None,
        "sensors": {name: each.unit for name, each in robot.sensors.items()},
    }


def _move(body: Robot, robot: RobotFiles) -> tuple[dict[str, float], float]:
    """Let the robot hover or stand, follow a step along x, brake, and turn if it can.

    Return facts about it: largest distance from its place at rest [m], commanded speed of the step
    [m/s], part of it at the end of the step [1], least deceleration that explains the braking
    distance [m/s^2], and the part of a yaw rate or of a velocity to its side [1]; and its speed at
    the end of braking [m/s].
    """
    simulator = body.simulator
    simulator.reset()
    body.onboard.reset()
    climb = (0.0, 0.0, 0.0 if robot.planar else CLIMB)
    reference = _follow(body, robot, ZERO, climb, RISE)
    reference = _follow(body, robot, reference, ZERO, 1.0)
    place = simulator.readings.position
    reference = _follow(body, robot, reference, ZERO, STEADY)
    drift = dist(place, simulator.readings.position)
    speed = min(robot.guard.speed_max_mps or SPEED, SPEED)
    _follow(body, robot, reference, (speed, 0.0, 0.0), FAST)
    start, before = simulator.readings.position, _speed(body)
    _follow(body, robot, None, ZERO, STOP)
    way = hypot(*np.subtract(simulator.readings.position, start)[:2]) - REACTION * before
    rest, yaw = _speed(body), _yaw(body)
    facts = {
        "drift_m": drift,
        "step_mps": speed,
        "step_reached": before / speed,
        "braking_measured_mps2": min(before * before / (2.0 * max(way, 1e-9)), BRAKING_MAX),
    }
    if robot.heading == "free":
        _follow(body, robot, ZERO, ZERO, TURNING, TURN)
        facts["turn_reached"] = remainder(_yaw(body) - yaw, tau) / (TURN * TURNING)
    elif robot.heading == "velocity":
        x, y = -sin(yaw), cos(yaw)  # to its left
        _follow(body, robot, ZERO, (speed * x, speed * y, 0.0), FAST)
        reached = simulator.readings.velocity
        facts["side_reached"] = (reached[0] * x + reached[1] * y) / speed
    return facts, rest


def _follow(
    body: Robot,
    robot: RobotFiles,
    reference: Vector | None,
    wanted: Vector,
    duration: float,
    yaw_rate: float = 0.0,
) -> Vector | None:
    """Follow `wanted` [m/s] and `yaw_rate` [rad/s] for a time [s]; return the last reference [m/s].

    The reference starts at `reference` and changes as fast as the guard allows; None: brake.
    """
    simulator = body.simulator
    change = robot.guard.acceleration_max_mps2 * STEP
    for _ in range(round(duration / STEP)):
        if reference is not None:
            reference = step_towards(reference, wanted, change)
        goal, brakes = reference or wanted, reference is None
        simulator.step(body.steer(simulator.readings, goal, yaw_rate, brakes=brakes))
        if simulator.readings.axes[8] < UPRIGHT_MIN:
            raise ValueError("the robot turns over: check its gains")
    return reference


def _speed(body: Robot) -> float:
    x, y, _ = body.simulator.readings.velocity
    return hypot(x, y)


def _yaw(body: Robot) -> float:
    axes = body.simulator.readings.axes
    return atan2(axes[1], axes[0])


def _judge(robot: RobotFiles, facts: Mapping[str, Any], rest: float) -> Iterator[str]:
    """Yield what must change because of the motion; `rest` is the robot's last speed [m/s]."""
    speed, braking = facts["step_mps"], facts["braking_measured_mps2"]
    turned, aside = facts.get("turn_reached", 1.0), facts.get("side_reached", 1.0)
    if facts["drift_m"] > DRIFT_MAX:
        yield f"the robot does not keep its place: it drifts {facts['drift_m']:.2f} m"
    reaches = "the robot reaches {:.0%} of a velocity of {:g} m/s {}: {}"
    if abs(facts["step_reached"] - 1.0) > SHORT:
        hint = "check the onboard controller, or set guard.speed_max_mps"
        yield reaches.format(facts["step_reached"], speed, "along x", hint)
        return
    if turned < 1.0 - SHORT:
        yield (
            f"robot.yaml: heading is free, but the robot follows {max(turned, 0.0):.0%} of a yaw "
            f"rate of {TURN:g} rad/s: let it follow, or set heading: fixed"
        )
    if abs(aside - 1.0) > SHORT:
        hint = "raise turn_rate_max or turn_gain, also of wheels that skid sideways in a turn"
        yield reaches.format(aside, speed, "to its left", hint)
    if rest > REST:
        yield f"the robot still moves at {rest:.2f} m/s, {STOP:g} s after it brakes"
    if braking < robot.guard.braking_mps2:
        yield (
            f"robot.yaml: guard.braking_mps2 is {robot.guard.braking_mps2:g}, but the robot brakes "
            f"with {braking:.2f} m/s^2; set it to {int(braking * 10) / 10:g} or less"
        )


def facts_table(facts: Mapping[str, Any]) -> str:
    """Format the facts that `check` returns for people."""
    return table([(key, _shown(value)) for key, value in facts.items()])


def _shown(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.3g}"
    if isinstance(value, Mapping):
        told = (f"{key} {_shown(each)}" for key, each in value.items() if each is not None)
        return ", ".join(told) or "none"
    if isinstance(value, list | tuple):
        return ", ".join(map(_shown, value)) or "none"
    return "from the model" if value is None else str(value)
