# SPDX-License-Identifier: Apache-2.0

"""Build a robot in its scene: model, onboard controller, actuators and guard."""

from __future__ import annotations

import inspect
from copy import copy
from pathlib import Path
from typing import Any

from cloudrc.base import plugins
from cloudrc.base.outside.document import KeyPath
from cloudrc.base.outside.refusal import naming
from cloudrc.base.outside.values import RESULT
from cloudrc.config.choice import PlugIn
from cloudrc.config.disturbances import Plant
from cloudrc.config.overrides import BRAKING, build_plugin, onboard_values
from cloudrc.config.problems import ProblemsError, at_key, problem_at
from cloudrc.config.resolved import ResolvedGuard
from cloudrc.config.robot import RobotFiles, parameters
from cloudrc.config.shipped import ROBOT_FILE, file_of
from cloudrc.config.world import ResolvedWorld
from cloudrc.physics.sim.airframe import thrust_to_weight
from cloudrc.physics.sim.energy import EnergyMeter, power_factors
from cloudrc.physics.sim.onboard import Accelerator, Actuators, Direct, Onboard
from cloudrc.physics.sim.plant import Wind
from cloudrc.physics.sim.scene import (
    compile_true,
    find_camera,
    find_part,
    find_sensors,
)
from cloudrc.physics.sim.simulator import Simulator, rest_height
from cloudrc.wire.messages import ZERO, Vector
from cloudrc.world.guard.state import Guard
from cloudrc.world.robot import STEP, Robot

KIND = "onboard"
"""Kind of plug-in."""
REST_ERROR_MAX = 0.005
"""Largest distance of a planar robot at rest from the height of the spawn [m]."""
SETTLING = 1.0
"""Time in which a planar robot comes to rest on the ground [s]."""
THRUST_TO_WEIGHT_MIN = 1.5
"""Smallest ratio of the largest thrust to the weight [1]: a tilted robot still climbs."""


def check_robot(world: ResolvedWorld, *, turns: bool = False) -> None:
    """Check that the robot compiles and can move as `world` says, and with `turns` obeys a yaw."""
    onboard = build_robot(world, ResolvedGuard.model_validate({})).onboard
    advise(world, ZERO)
    if turns and not getattr(onboard, "obeys_yaw", True):
        reason = f"the onboard controller of {world.robot} does not obey a yaw; leave yaw_deg out"
        raise problem_at("mission.waypoints", reason)


def build_robot(world: ResolvedWorld, limits: ResolvedGuard, wind: Wind | None = None) -> Robot:
    """Compile the robot that flies or drives in a scene, and build it, guarded by `limits`."""
    robot = world.files.robot
    with naming(f"robot {world.robot}"):
        # A copy, because an onboard controller of a user gets it, and may change it.
        nominal = copy(world.files.compiled)
    with at_key("world.robot", f"{_file_of(world)}: onboard: "):
        # The build below uses the same import of the file.
        plugin = plugins.find(KIND, robot.onboard.name)
    onboard = _build_onboard(world, robot, nominal)
    model = _change(world, robot, nominal)
    actuators = _build_actuators(plugin, nominal, parameters(robot, world))
    is_direct = type(actuators) is Direct  # RotorDrag has drag
    if is_direct and not plugin.is_shipped:
        with plugin.calling("build"):
            RESULT.row(onboard.stopped, nominal.nu, "stopped")
    if robot.planar:
        _check_rest(world, model, onboard.stopped if is_direct else (0.0,) * model.nu)
    else:
        _check_lift(world, model)
    if world.wind.blows and is_direct:
        reason = (
            f"{world.robot} has actuators without drag, so wind would not move it; leave the wind "
            "out, or give them drag (multirotor has the parameter drag_s_per_m)"
        )
        raise problem_at("world.wind", reason)
    with naming(f"{world.robot}/{ROBOT_FILE}"):
        sensors = find_sensors(nominal, robot.sensors)
        if robot.probe is not None:
            find_part(nominal, "site", robot.probe, "probe")
        if robot.scan is not None:
            find_part(nominal, "site", robot.scan.site, "scan.site")
        if robot.camera is not None:
            find_camera(nominal, robot.camera)
    judges = not (is_direct or plugin.is_shipped)
    with plugin.calling("actuators" if judges else "build"):
        simulator = Simulator(model, actuators, wind, robot.probe, sensors, judges=judges)
    if (factors := power_factors(model, nominal, robot.thrust_n_s2)) is not None:
        simulator.meter = EnergyMeter(simulator.data, factors)
    return _connect(world, plugin, simulator, onboard, limits)


def _connect(
    world: ResolvedWorld,
    plugin: plugins.Found,
    simulator: Simulator,
    onboard: Onboard,
    limits: ResolvedGuard,
) -> Robot:
    """Make the robot of its parts, with what runs its usual steps faster, if there is any."""
    robot_files, faster = world.files.robot, accelerator(world, plugin)
    guard = Guard(limits, world.files.fence, robot_files.guard)
    make = Robot if faster is None else faster.make or Robot
    with plugin.calling("build" if make is Robot else "accelerator"):
        robot: Robot = make(simulator, onboard, guard)
    if not plugin.is_shipped:
        robot.name = Path(robot_files.onboard.name).name
    return robot


def advise(world: ResolvedWorld, gains: Vector) -> tuple[str, ...]:
    """Return the warnings of the onboard controller about a world that differs from its model.

    Its plug-in may have a function `advise(world, values, gains)`; `values` are its parameters.
    `gains` are the cloud's velocities per distance from the setpoint [1/s], 0 if unknown.
    """
    plugin = plugins.find(KIND, world.files.robot.onboard.name)
    if plugin.get("advise") is None:
        return ()
    values = onboard_values(world.files.robot, world)
    with plugin.calling("advise") as function:
        return tuple(map(str, function(world, values, gains)))


def accelerator(world: ResolvedWorld, plugin: plugins.Found | None = None) -> Accelerator | None:
    """Return what can run the usual steps of a robot faster; None if nothing can.

    `plugin` is the file of its onboard controller, if it is loaded.
    """
    plugin = plugin or plugins.find(KIND, world.files.robot.onboard.name)
    if not world.is_nominal or plugin.get("accelerator") is None:
        return None
    with plugin.calling("accelerator") as function:
        return function()  # type: ignore[no-any-return]


def describe_steps(world: ResolvedWorld) -> str:
    """Say in which language the usual steps of a robot run on this machine."""
    faster = accelerator(world)
    if faster is None:
        return "Python (wind, a robot that differs from its model, or one without steps in C)"
    return faster.text


def _build_onboard(world: ResolvedWorld, robot: RobotFiles, model: Any) -> Onboard:
    """Build the onboard controller for a compiled `MjModel`."""
    name = robot.onboard.name
    choice = PlugIn.model_validate({**parameters(robot, world), "name": name})
    with at_key("world.robot", f"{robot.model} in {file_of(world.scene)}: "):
        try:
            offered = {"model": model, BRAKING: robot.guard.braking_mps2}
            return build_plugin(KIND, choice, **offered)  # type: ignore[no-any-return]
        except ProblemsError as error:  # about its parameters
            first = error.problems[0]
            raise _problem(world, first.path, f"{first._replace(path=())} ({name})") from error


def _problem(world: ResolvedWorld, path: KeyPath, reason: str) -> ProblemsError:
    """Return the error at the key that gives a parameter of the onboard controller.

    `path` is the parameter, and the keys inside its value.
    """
    if path[0] in (world.onboard.model_extra or {}):
        return problem_at(".".join(("world.onboard", *path)), reason)
    tuning = world.files.robot.tunings.get(world.tuning or "")
    where, key = ".".join(("onboard", *path)), "world.robot"
    if tuning and path[0] in (tuning.model_extra or {}):
        where, key = ".".join(("tunings", str(world.tuning), *path)), "world.tuning"
    return problem_at(key, f"{_file_of(world)}: {where}: {reason}")


def _file_of(world: ResolvedWorld) -> str:
    return world.robot if world.robot.endswith(".xml") else f"{world.robot}/{ROBOT_FILE}"


def _change(world: ResolvedWorld, robot: RobotFiles, nominal: Any) -> Any:
    """Return the model of the true robot, which may differ from the `nominal` one."""
    factors = world.plant.actuator_factor
    if world.plant == Plant():
        return nominal
    if isinstance(factors, tuple) and len(factors) != nominal.nu:
        reason = (
            f"has {len(factors)} factors, but {robot.model} has {nominal.nu} actuators; give as "
            "many, or one number for all"
        )
        raise problem_at("world.plant.actuator_factor", reason)
    with naming(f"robot {world.robot}"):
        return compile_true(robot.model, file_of(world.scene), nominal, world.plant)


def _check_rest(world: ResolvedWorld, model: Any, stopped: tuple[float, ...]) -> None:
    """Check that a planar robot stands at the height of the spawn.

    Missions have this height, and the robot cannot change it. `model` is the compiled `MjModel`,
    `stopped` the commands of the robot at rest.
    """
    base, spawn = rest_height(model, stopped, SETTLING), world.files.scene.spawn[2]
    if abs(base - spawn) > REST_ERROR_MAX:
        raise problem_at(
            "world.robot",
            f"the base of {world.robot} rests at a height of {base:.3f} m, but the spawn of the "
            f"scene {world.scene} is at {spawn:.3f} m: move all parts inside the base, or set "
            "this height in the frame spawn of a scene of your own",
        )


def _check_lift(world: ResolvedWorld, model: Any) -> None:
    """Check that the true robot, a compiled `MjModel`, can lift off safely."""
    ratio = thrust_to_weight(model)
    if ratio is not None and ratio < THRUST_TO_WEIGHT_MIN:
        raise problem_at(
            "world.robot" if world.is_nominal else "world.plant",
            f"the thrust-to-weight ratio of {world.robot} is {ratio:.2f}, so it cannot lift off "
            f"safely; it must be at least {THRUST_TO_WEIGHT_MIN:g}: more thrust or less mass",
        )


def _build_actuators(plugin: plugins.Found, model: Any, given: dict[str, Any]) -> Actuators:
    """Make the actuators; they get those parameters of the controller that they name, too."""
    if plugin.get("actuators") is None:
        return Direct(model.nu)
    with plugin.calling("actuators") as function:
        known = inspect.signature(function).parameters
        own = {name: value for name, value in given.items() if name in known}
        return function(model, STEP, **own)  # type: ignore[no-any-return]
