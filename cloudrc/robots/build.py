"""Build a robot in its scene: model, onboard controller, actuators and guard."""

from __future__ import annotations

import inspect
from typing import TYPE_CHECKING, Any

from cloudrc import plugins
from cloudrc.config.overrides import build_plugin
from cloudrc.config.robot import RobotFiles, find_robot
from cloudrc.config.schema import LowLevel, PlugIn, World
from cloudrc.config.shipped import file_of
from cloudrc.errors import BadInputError
from cloudrc.world.guard.state import Guard
from cloudrc.world.onboard import Actuators, Direct, Onboard
from cloudrc.world.plant import Wind
from cloudrc.world.robot import STEP, Robot
from cloudrc.world.scene import compile_model, compile_true
from cloudrc.world.simulator import Simulator

if TYPE_CHECKING:
    from cloudrc.config.load import ResolvedGuard

KIND = "onboard"
"""Kind of plug-in."""
GENERAL = PlugIn(name="multirotor")
"""Onboard controller of a model without `robot.yaml` that is not like the Pelican."""


def check_robot(world: World) -> None:
    """Raise a BadInputError if the robot does not compile or its controller refuses the model."""
    robot, scene = find_robot(world.robot), file_of(world.scene)
    model = compile_model(robot.model, scene)
    _build_onboard(world, f"{robot.model} in {scene}", model, controller(robot, model))


def build_robot(world: World, limits: ResolvedGuard, wind: Wind | None = None) -> Robot:
    """Build the robot that flies or drives in a scene, guarded by `limits`.

    Raises:
        BadInputError: If the robot does not compile or its controller refuses the model.
    """
    robot, scene = find_robot(world.robot), file_of(world.scene)
    nominal = compile_model(robot.model, scene)
    choice = controller(robot, nominal)
    onboard = _build_onboard(world, f"{robot.model} in {scene}", nominal, choice)
    plugin = plugins.find(KIND, choice.name)
    true = compile_true(robot.model, scene, nominal, world.plant)
    simulator = Simulator(true, _actuators(plugin, nominal, choice), wind)
    guard = Guard(limits, robot.guard, planar=robot.planar)
    if world.is_nominal and hasattr(plugin, "accelerate"):
        return plugin.accelerate(simulator, onboard, guard)  # type: ignore[no-any-return]
    return Robot(simulator, onboard, guard)


def controller(robot: RobotFiles, model: Any) -> PlugIn:
    """Return the onboard controller of a robot.

    A model without `robot.yaml` is flown by the Pelican's controller if the model, a compiled
    `MjModel`, is enough like the Pelican, and else by `GENERAL`.
    """
    if robot.onboard is not None:
        return robot.onboard
    from cloudrc.robots.pelican.fit import check_fit

    try:
        check_fit(model)
    except BadInputError:
        return GENERAL
    pelican = find_robot("pelican").onboard
    assert pelican is not None
    return pelican


def runs_in_c(world: World) -> bool:
    """Return whether the usual physics steps of a robot can run in C."""
    if not world.is_nominal:
        return False
    robot = find_robot(world.robot)
    model = compile_model(robot.model, file_of(world.scene)) if robot.onboard is None else None
    return hasattr(plugins.find(KIND, controller(robot, model).name), "accelerate")


def _build_onboard(world: World, where: str, model: Any, choice: PlugIn) -> Onboard:
    """Build an onboard controller for a compiled `MjModel`; errors name the files in `where`."""
    parameters = dict(choice.model_extra or {})
    if world.low_level != LowLevel():
        known = plugins.signature(KIND, choice.name).parameters
        if unknown := LowLevel.model_fields.keys() - known:
            raise BadInputError(
                f"world.low_level: the onboard controller {choice.name} of {where} has no "
                f"{', '.join(sorted(unknown))}; leave this section out"
            )
        parameters |= world.low_level.model_dump()
    try:
        return build_plugin(  # type: ignore[no-any-return]
            KIND, choice.model_copy(update=parameters), model=model
        )
    except BadInputError as error:
        raise BadInputError(f"{where}: {error}") from error


def _actuators(plugin: Any, model: Any, onboard: PlugIn) -> Actuators:
    """Make the actuators; they get those parameters of the controller that they name, too."""
    if not hasattr(plugin, "actuators"):
        return Direct(model.nu)
    known, given = inspect.signature(plugin.actuators).parameters, onboard.model_extra or {}
    own = {name: value for name, value in given.items() if name in known}
    return plugin.actuators(model, STEP, **own)  # type: ignore[no-any-return]
