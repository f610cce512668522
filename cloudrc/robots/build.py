"""Build a robot in its scene: model, onboard controller, actuators and guard."""

from __future__ import annotations

import inspect
from typing import TYPE_CHECKING, Any

from cloudrc import plugins
from cloudrc.config.overrides import build_plugin
from cloudrc.config.robot import find_robot
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


def check_robot(world: World) -> None:
    """Raise a BadInputError if the robot does not compile or its controller refuses the model."""
    build_onboard(world, compile_model(find_robot(world.robot).model, file_of(world.scene)))


def build_robot(world: World, limits: ResolvedGuard, wind: Wind | None = None) -> Robot:
    """Build the robot that flies or drives in a scene, guarded by `limits`.

    Raises:
        BadInputError: If the robot does not compile or its controller refuses the model.
    """
    robot, scene = find_robot(world.robot), file_of(world.scene)
    nominal = compile_model(robot.model, scene)
    onboard, plugin = build_onboard(world, nominal), plugins.find(KIND, robot.onboard.name)
    simulator = Simulator(
        compile_true(robot.model, scene, nominal, world.plant),
        _actuators(plugin, nominal, robot.onboard),
        wind,
    )
    guard = Guard(limits)
    if world.is_nominal and hasattr(plugin, "accelerate"):
        return plugin.accelerate(simulator, onboard, guard)  # type: ignore[no-any-return]
    return Robot(simulator, onboard, guard)


def build_onboard(world: World, model: Any) -> Onboard:
    """Build the onboard controller for the compiled `MjModel` of the robot in its scene."""
    robot = find_robot(world.robot)
    parameters = dict(robot.onboard.model_extra or {})
    if world.low_level != LowLevel():
        known = plugins.signature(KIND, robot.onboard.name).parameters
        if unknown := LowLevel.model_fields.keys() - known:
            raise BadInputError(
                f"world.low_level: the onboard controller of {world.robot} has no "
                f"{', '.join(sorted(unknown))}; leave this section out"
            )
        parameters |= world.low_level.model_dump()
    choice = robot.onboard.model_copy(update=parameters)
    try:
        return build_plugin(KIND, choice, model=model)  # type: ignore[no-any-return]
    except BadInputError as error:
        raise BadInputError(f"{robot.model} in {file_of(world.scene)}: {error}") from error


def _actuators(plugin: Any, model: Any, onboard: PlugIn) -> Actuators:
    """Make the actuators; they get those parameters of the controller that they name, too."""
    if not hasattr(plugin, "actuators"):
        return Direct(model.nu)
    known, given = inspect.signature(plugin.actuators).parameters, onboard.model_extra or {}
    own = {name: value for name, value in given.items() if name in known}
    return plugin.actuators(model, STEP, **own)  # type: ignore[no-any-return]
