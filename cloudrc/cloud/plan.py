"""Plan future commands: roll the predictor's model forward under a copy of the controller."""

from __future__ import annotations

from copy import deepcopy
from math import isfinite

from cloudrc.cloud.controllers import Controller
from cloudrc.cloud.predictors import Model
from cloudrc.messages import PLAN_STEP_NS, Setpoint, Vector
from cloudrc.teleop.carrot import setpoint_at
from cloudrc.tunnel.codec import as_planned

STEP = PLAN_STEP_NS * 1e-9
"""Time between two velocities of a plan [s]."""
SPEED_MAX = 1000.0
"""Largest component of a planned velocity [m/s]; the guard refuses a plan with a larger one.
Source: docs/reference/faults.md, "F23"."""
PLUGIN_ERRORS = (Exception, SystemExit, GeneratorExit)
"""What counts as the failure of a plug-in. A user's Ctrl-C does not."""


class ControllerError(Exception):
    """The controller failed during `make_plan`; `__cause__` is the controller's exception."""


def make_plan(
    model: Model,
    controller: Controller,
    setpoint: Setpoint,
    velocity: Vector,
    now_ns: int,
    count: int,
) -> tuple[Vector, ...]:
    """Compute the velocities [m/s] that follow a command, one per STEP; at most `count`.

    Args:
        model: Model of the robot at the time for which the command was computed; it is changed.
        controller: Controller after it has computed the command; it is copied, not changed.
        setpoint: Setpoint, with its motion.
        velocity: Velocity of the command [m/s].
        now_ns: Time of the command [ns], cloud's clock.
        count: Largest number of velocities.

    Returns:
        The plan; it ends before a velocity that the guard would refuse.

    Raises:
        ControllerError: If the controller cannot be copied, or fails.
    """
    plan = list[Vector]()
    try:
        controller = deepcopy(controller)
    except PLUGIN_ERRORS as error:
        raise ControllerError from error
    for k in range(1, count + 1):
        state, later = model.step(velocity, STEP), setpoint_at(setpoint, now_ns + k * PLAN_STEP_NS)
        try:
            x, y, z = controller.update(state, later, STEP).velocity
            velocity = (float(x), float(y), float(z))
        except PLUGIN_ERRORS as error:
            raise ControllerError from error
        largest = max(map(abs, velocity))
        if not (isfinite(sum(velocity)) and largest <= SPEED_MAX):
            break
        plan.append(as_planned(velocity))
    return tuple(plan)
