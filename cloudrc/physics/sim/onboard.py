# SPDX-License-Identifier: Apache-2.0

"""What a robot brings besides its model: an onboard controller, and the physics of its actuators.

World knows no kind of robot. In every physics step it hands the controller the readings and the
velocity that the guard allows, and hands the actuators what the controller commands:

    readings, velocity > Onboard > commands > Actuators > inputs > MuJoCo > readings
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, TypeAlias

from cloudrc.physics.sim.readings import Readings
from cloudrc.wire.messages import Vector

Commands: TypeAlias = tuple[float, ...]
"""One value for each actuator, in the order of the robot's model, such as speeds [rad/s]."""
Inputs: TypeAlias = tuple[float, ...]
"""Input to MuJoCo in one step: one value for each actuator of the model, such as a thrust [N], then
further forces at the base's origin: a force in the world frame [N] and a torque in the body frame
[N m], as MuJoCo's free joint requires."""


class Onboard(Protocol):
    """Makes the robot follow a velocity; world calls it in every physics step.

    Attributes:
        stopped: Commands while the guard has stopped the robot. World tells by identity whether the
            robot is stopped, so `update` and `brake` must not return this object.

    A controller that ignores the yaw rate says so with an attribute `obeys_yaw`, which is False.
    """

    stopped: Commands

    def reset(self) -> None:
        """Forget everything; the robot is stopped."""

    def update(self, readings: Readings, velocity: Vector, yaw_rate: float) -> Commands:
        """Return the commands that make the robot follow a velocity and a yaw rate.

        `velocity` is in [m/s], world frame, shape (3,). `yaw_rate` is in [rad/s], about the world's
        z axis.
        """

    def brake(self, readings: Readings, velocity: Vector) -> Commands:
        """Return commands as `update` does, while the guard brakes the robot to a velocity.

        `velocity` is in [m/s], world frame, shape (3,).
        """


class Actuators(Protocol):
    """Physics of the actuators, for example their lag and their drag.

    Attributes:
        speeds: What the actuators do at present, in the order and the units of `Commands`.
    """

    speeds: Commands

    def reset(self) -> None:
        """Stand still."""

    def step(self, commands: Commands, readings: Readings) -> Inputs:
        """Advance by one physics step towards `commands`; return the input to MuJoCo.

        The velocity of `readings` is relative to the air.
        """


class Accelerator(NamedTuple):
    """Code that runs the usual steps of a robot faster than Python, with the same results.

    A plug-in of an onboard controller may have a function `accelerator()` that returns it.
    """

    # Makes a `Robot` of simulator, onboard controller and guard; None: this machine cannot run it.
    make: Callable[..., Any] | None
    text: str  # language of the steps, and where the code is from or why it is missing
    code: str = ""  # hash of the machine code


class Direct:
    """Actuators that MuJoCo alone simulates: they get the commands unchanged."""

    def __init__(self, count: int) -> None:
        """Begin at rest, with `count` actuators."""
        self._rest: Commands = (0.0,) * count
        self.speeds = self._rest

    def reset(self) -> None:
        """Stand still."""
        self.speeds = self._rest

    def step(self, commands: Commands, readings: Readings) -> Inputs:
        """Return the commands as MuJoCo's input, without further forces."""
        self.speeds = commands
        return (*commands, *_NO_FORCES)


_NO_FORCES = (0.0,) * 6
