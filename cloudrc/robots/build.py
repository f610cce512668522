"""Build a robot in its scene: model, onboard controller, actuators and guard."""

from __future__ import annotations

import inspect
import re
from contextlib import suppress
from typing import Any, NamedTuple

from cloudrc import plugins
from cloudrc.config.overrides import BRAKING, build_plugin, check_plugin, default_parameters
from cloudrc.config.problems import ConfigProblem, ProblemsError
from cloudrc.config.resolved import ResolvedGuard
from cloudrc.config.robot import GENERAL, RobotFiles, find_robot, parameters
from cloudrc.config.scene import scene_of, steered_in
from cloudrc.config.schema import PlugIn, World
from cloudrc.config.shipped import ROBOT_FILE, file_of
from cloudrc.errors import BadInputError
from cloudrc.geometry.compiled import mujoco
from cloudrc.messages import ZERO, Vector
from cloudrc.outside import code
from cloudrc.outside.document import KeyPath
from cloudrc.outside.values import RESULT, shorten
from cloudrc.robots.onboard._airframe import thrust_to_weight
from cloudrc.world.accelerated import AcceleratedRobot
from cloudrc.world.guard.state import Guard
from cloudrc.world.onboard import Accelerator, Actuators, Commands, Direct, Onboard
from cloudrc.world.own_sensors import OwnSensor, find_sensors
from cloudrc.world.plant import Wind
from cloudrc.world.robot import STEP, Robot
from cloudrc.world.scene import compile_model, compile_true
from cloudrc.world.simulator import Simulator, find_site
from cloudrc.world.watched import WatchedActuators, WatchedOnboard

KIND = "onboard"
"""Kind of plug-in."""
REST_ERROR_MAX = 0.005
"""Largest distance of a planar robot at rest from the height of the spawn [m]."""
SETTLING = 1.0
"""Time in which a planar robot comes to rest on the ground [s]."""
THRUST_TO_WEIGHT_MIN = 1.5
"""Smallest ratio of the largest thrust to the weight [1]: a tilted robot still climbs."""


class Parts(NamedTuple):
    """The parts of a robot in its scene, before they are connected."""

    model: Any  # compiled `MjModel` of the true robot
    plugin: plugins.Found  # file of the onboard controller
    onboard: Onboard
    actuators: Actuators
    probe: str | None  # site with which the robot touches; None: any part of it touches
    sensors: tuple[OwnSensor, ...]


def check_robot(world: World, *, turns: bool = False) -> None:
    """Raise a BadInputError if the robot does not compile, or if it cannot move as `world` says.

    With `turns`, it also has to obey a yaw.
    """
    build_robot(world, ResolvedGuard.model_validate({}))
    advise(world, ZERO)
    if turns and not obeys_yaw(world):
        reason = f"the onboard controller of {world.robot} does not obey a yaw; leave yaw_deg out"
        raise ProblemsError([ConfigProblem(("mission", "waypoints"), "", reason)])


def obeys_yaw(world: World) -> bool:
    """Return whether the onboard controller of a robot follows a yaw rate."""
    return bool(getattr(_make_parts(world).onboard, "obeys_yaw", True))


def build_robot(world: World, limits: ResolvedGuard, wind: Wind | None = None) -> Robot:
    """Build the robot that flies or drives in a scene, guarded by `limits`.

    Raises:
        BadInputError: If the robot does not compile, or if it cannot move as `world` says.
    """
    model, plugin, onboard, actuators, probe, sensors = _make_parts(world)
    robot = find_robot(world.robot)
    guard = Guard(limits, steered_in(world), robot.guard)
    faster = _accelerator(world, plugin)
    make = None if faster is None else faster.make
    if make is not None and plugin.is_shipped:
        simulator = Simulator(model, actuators, wind, probe, sensors)
        return make(simulator, onboard, guard)  # type: ignore[no-any-return]
    with plugin.calling("build"):
        if not isinstance(actuators, Direct):
            actuators = WatchedActuators(actuators, model.nu)
        simulator = Simulator(model, actuators, wind, probe, sensors)
        if make is None:
            return Robot(simulator, WatchedOnboard(onboard), guard)
    with plugin.calling("accelerator"):
        return AcceleratedRobot(simulator, onboard, guard, make)


def controller(robot: RobotFiles, model: Any) -> PlugIn:
    """Return the onboard controller of a robot, as its `robot.yaml` says.

    A model without `robot.yaml` is flown by the Pelican's controller if the model, a compiled
    `MjModel`, is enough like the Pelican, and else by `GENERAL`.
    """
    if robot.onboard is not None:
        return robot.onboard
    from cloudrc.robots.pelican.fit import check_fit

    try:
        check_fit(model)
    except BadInputError:
        return PlugIn(name=GENERAL)
    pelican = find_robot("pelican").onboard
    assert pelican is not None
    return pelican


def onboard_values(world: World) -> dict[str, Any]:
    """Return all parameters of the onboard controller with their values, including defaults."""
    robot, choice = _choose(world)
    return default_parameters(KIND, choice.name) | parameters(robot, world)


def advise(world: World, gains: Vector) -> tuple[str, ...]:
    """Return the warnings of the onboard controller about a world that differs from its model.

    Its plug-in may have a function `advise(world, values, gains)`; `values` are its parameters.
    `gains` are the cloud's velocities per distance from the setpoint [1/s], 0 if unknown.
    """
    return _advise(plugins.find(KIND, _choose(world)[1].name), world, gains)


def _advise(plugin: plugins.Found, world: World, gains: Vector) -> tuple[str, ...]:
    if plugin.get("advise") is None:
        return ()
    values = onboard_values(world)
    with plugin.calling("advise") as function:
        advice = function(world, values, gains)
        texts = () if isinstance(advice, str) else tuple(advice)
        if isinstance(advice, str) or not all(isinstance(text, str) for text in texts):
            raise ValueError(f"it returned {shorten(advice)}, not texts; yield each text")
        return texts


def accelerator(world: World) -> Accelerator | None:
    """Return what can run the usual steps of a robot faster; None if nothing can."""
    return _accelerator(world, plugins.find(KIND, _choose(world)[1].name))


def describe_steps(world: World) -> str:
    """Say in which language the usual steps of a robot run on this machine."""
    faster = accelerator(world)
    if faster is None:
        return "Python (wind, a robot that differs from its model, or one without steps in C)"
    return faster.text


def _accelerator(world: World, plugin: plugins.Found) -> Accelerator | None:
    if not world.is_nominal or plugin.get("accelerator") is None:
        return None
    with plugin.calling("accelerator") as function:
        faster = function()
        if not isinstance(faster, Accelerator | None):
            raise ValueError(f"it returned {shorten(faster)}, no Accelerator")
        return faster


def _choose(world: World) -> tuple[RobotFiles, PlugIn]:
    """Return a robot and its onboard controller; a robot without `robot.yaml` is compiled."""
    robot = find_robot(world.robot)
    model = compile_model(robot.model, file_of(world.scene)) if robot.onboard is None else None
    return robot, controller(robot, model)


def _make_parts(world: World) -> Parts:
    robot, scene = find_robot(world.robot), file_of(world.scene)
    nominal, where = compile_model(robot.model, scene), f"{robot.model} in {scene}"
    choice = controller(robot, nominal)
    try:
        plugin = plugins.find(KIND, choice.name)  # the build below uses the same import of the file
    except BadInputError as error:
        raise ProblemsError([_problem(world, (), str(error))]) from error
    onboard = _build_onboard(world, where, choice, robot, nominal)
    true = compile_true(robot.model, scene, nominal, world.plant)
    if not robot.planar:
        _check_lift(world, where, true)
    actuators = _build_actuators(plugin, nominal, parameters(robot, world))
    _check_onboard(choice.name, onboard, nominal.nu if isinstance(actuators, Direct) else None)
    if robot.planar:
        stopped = onboard.stopped if isinstance(actuators, Direct) else (0.0,) * true.nu
        _check_rest(world, where, true, stopped)
    if world.wind.blows and isinstance(actuators, Direct):
        _refuse_wind(world, plugin)
    try:
        probe = _find_probe(robot, choice, nominal)
        sensors = find_sensors(nominal, robot.sensors)
    except BadInputError as error:
        raise BadInputError(f"{world.robot}/{ROBOT_FILE}: {error}") from error
    return Parts(true, plugin, onboard, actuators, probe, sensors)


def _find_probe(robot: RobotFiles, choice: PlugIn, model: Any) -> str | None:
    """Return the site with which a robot touches; None if any part of it touches.

    A model without `robot.yaml` that has the Pelican's controller has its probe, too.
    """
    if robot.probe is not None:
        find_site(model, robot.probe)
        return robot.probe
    pelican = find_robot("pelican")
    if robot.onboard is not None or choice != pelican.onboard:
        return None
    with suppress(BadInputError):
        find_site(model, pelican.probe or "")
        return pelican.probe
    return None


def _build_onboard(
    world: World, where: str, choice: PlugIn, robot: RobotFiles, model: Any
) -> Onboard:
    """Build an onboard controller for a compiled `MjModel`; errors name the files in `where`."""
    given = parameters(robot, world)
    choice = PlugIn.model_validate({**given, "name": choice.name})
    if found := check_plugin(KIND, choice):
        by = f" (controller of {world.robot}: {choice.name})"
        raise ProblemsError([_problem(world, p.path, f"{p._replace(path=())}{by}") for p in found])
    try:
        more = {}
        if BRAKING in plugins.signature(KIND, choice.name).parameters:
            more = {BRAKING: robot.guard.braking_mps2}
        return build_plugin(KIND, choice, model=model, **more)  # type: ignore[no-any-return]
    except BadInputError as error:
        named = next((key for key in given if re.search(rf"\b{key}\b", str(error))), None)
        if named is None:
            problem = ConfigProblem(("world", "robot"), "", f"{where}: {error}")
        else:
            problem = _problem(world, (named,), str(error))
        raise ProblemsError([problem]) from error


def _problem(world: World, path: KeyPath, reason: str) -> ConfigProblem:
    """Return a problem at the key that gives a parameter of the onboard controller.

    `path` is the parameter, and the keys inside its value; () means the controller itself.
    """
    if path and path[0] in (world.onboard.model_extra or {}):
        return ConfigProblem(("world", "onboard", *path), "", reason)
    file = world.robot if world.robot.endswith(".xml") else f"{world.robot}/{ROBOT_FILE}"
    if path and path[0] in find_robot(world.robot).tunings.get(world.tuning or "", ()):
        key, place = "tuning", ("tunings", str(world.tuning), *path)
    else:
        key, place = "robot", ("onboard", *path)
    return ConfigProblem(("world", key), "", f"{file}: {'.'.join(place)}: {reason}")


def _check_rest(world: World, where: str, model: Any, stopped: Commands) -> None:
    """Raise a BadInputError if a planar robot does not stand at the height of the spawn.

    Missions have this height, and the robot cannot change it. `model` is the compiled `MjModel`,
    `stopped` the commands of the robot at rest.
    """
    data = mujoco.MjData(model)
    data.ctrl[:] = stopped
    mujoco.mj_step(model, data, round(SETTLING / STEP))
    base, spawn = float(data.qpos[2]), scene_of(world).spawn[2]
    if abs(base - spawn) <= REST_ERROR_MAX:
        return
    move = f"{abs(base - spawn):.3f} m {'down' if base < spawn else 'up'}"
    reason = (
        f"the base of {world.robot} rests at a height of {base:.3f} m, but the spawn of the "
        f"scene {world.scene} is at {spawn:.3f} m: move all parts inside the base {move}, or "
        "set this height in the frame spawn of a scene of your own"
    )
    raise ProblemsError([ConfigProblem(("world", "robot"), where, reason)])


def _check_lift(world: World, where: str, model: Any) -> None:
    """Raise a BadInputError if the true robot, a compiled `MjModel`, cannot lift off safely."""
    ratio = thrust_to_weight(model)
    if ratio is None or ratio >= THRUST_TO_WEIGHT_MIN:
        return
    hint = "give it more thrust or less mass"
    key = "robot"
    if not world.is_nominal:
        key, where = "plant", ""
        hint = "lower mass_factor or payload_kg, or raise actuator_factor"
    reason = (
        f"the thrust-to-weight ratio of {world.robot} is {ratio:.2f}, so it cannot lift "
        f"off safely; it must be at least {THRUST_TO_WEIGHT_MIN:g}: {hint}"
    )
    raise ProblemsError([ConfigProblem(("world", key), where, reason)])


def _build_actuators(plugin: plugins.Found, model: Any, given: dict[str, Any]) -> Actuators:
    """Make the actuators; they get those parameters of the controller that they name, too."""
    if plugin.get("actuators") is None:
        return Direct(model.nu)
    with plugin.calling("actuators") as function:
        known = inspect.signature(function).parameters
        own = {name: value for name, value in given.items() if name in known}
        actuators = function(model, STEP, **own)
        if not callable(getattr(actuators, "step", None)):
            raise ValueError(f"{type(actuators).__name__} has no method step()")
        actuators.reset()
        return actuators  # type: ignore[no-any-return]


def _check_onboard(name: str, onboard: Onboard, size: int | None) -> None:
    """Refuse the controller `name` if it lacks a part.

    `size` is the number of commands, None if unknown.
    """
    what = f"the onboard controller {name!r} does not hold the contract"
    with code.calling(what, slow=f"reset() of {name} is still running"):
        for method in ("reset", "update", "brake"):
            if not callable(getattr(onboard, method, None)):
                raise ValueError(f"{type(onboard).__name__} has no method {method}()")
        stopped = getattr(onboard, "stopped", None) or ()
        RESULT.row(stopped, len(stopped) if size is None else size, "stopped")
        onboard.reset()


def _refuse_wind(world: World, plugin: plugins.Found) -> None:
    """Raise the error about a wind that would not move the robot."""
    text = f"{world.robot} has actuators without drag, so wind would not move it; "
    if plugin.get("actuators") is not None:
        with plugin.calling("actuators") as function:
            known = inspect.signature(function).parameters
        keys = [f"world.onboard.{name}" for name in list(known)[2:]]
        text += f"set {' and '.join(keys)} above 0, or "
    raise ProblemsError([ConfigProblem(("world", "wind"), "", f"{text}leave the wind out")])
