# SPDX-License-Identifier: Apache-2.0

"""Models of a robot's motion under velocity commands, with which predictors replay commands."""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Sequence
from struct import Struct
from typing import TYPE_CHECKING, Self

from cloudrc.cloud.predictors import Model, moved
from cloudrc.wire.messages import ZERO, Odometry, Setpoint, Vector

if TYPE_CHECKING:
    from cloudrc.cloud.controllers.pid import Law


_pack = Struct("7d").pack


def pack_goal(setpoint: Setpoint) -> bytes:
    """Return position [m] and velocity [m/s] of a setpoint, and 1.0 if the velocity counts.

    A controller does not add a velocity that is ZERO: -0.0 would become 0.0.
    """
    position, moving = setpoint[0], setpoint[4]
    return _pack(*position, *moving, moving is not ZERO)


class Body(Model):
    """A model of the robot, in the state predicted for `horizon` [s] after the sample `basis`.

    `position` [m] and `velocity` [m/s] are those of the base, world frame.
    """

    basis: Odometry
    horizon: float
    position: Vector
    velocity: Vector

    def advance(self, command: Vector, dt: float) -> None:
        """Advance the state by `dt` [s] under a velocity command [m/s]."""
        raise NotImplementedError

    def replay(self, commands: Iterable[tuple[Vector, float]]) -> None:
        """Advance the state under several commands: velocity [m/s] and duration [s] of each."""
        for velocity, duration in commands:
            self.advance(velocity, duration)

    def coast(self, velocity: Vector, dt: float, count: int) -> array[float]:
        """Advance by `dt` [s], `count` times, under one command `velocity` [m/s].

        Return the position [m] and the velocity [m/s] after each step: six numbers of each.
        """
        states = (self.step(velocity, dt) for _ in range(count))
        return array("d", [n for each in states for n in (*each.position, *each.velocity)])

    def follow(
        self, law: Law, goals: Sequence[bytes], dt: float, velocity: Vector, most: float
    ) -> tuple[list[Vector], list[Vector]] | None:
        """Simulate a flight in which `law` computes the next velocity after each `dt` [s].

        The flight begins with `velocity`; `goals` are those of `pack_goal`. Return the velocity
        [m/s] for each of them, in single precision, and the position [m] in which it was computed.
        None: the model cannot do that in one call, or a component of a velocity is not at most
        `most` [m/s].
        """
        return None

    def __copy__(self) -> Self:
        """Return a copy; the module `copy` alone would take longer than a step of a model."""
        new = object.__new__(type(self))
        new.__dict__.update(self.__dict__)
        return new

    def correct(self, odometry: Odometry) -> None:
        """Adopt the state of a new sample, to which the model has advanced by the commands."""
        raise NotImplementedError

    def step(self, velocity: Vector, dt: float) -> Odometry:
        """Advance by `dt` [s] under the command `velocity` [m/s], and return the state."""
        self.advance(velocity, dt)
        self.horizon += dt
        return self.odometry()

    def odometry(self) -> Odometry:
        """Return the predicted state; its orientation follows from a constant angular velocity."""
        return moved(self.basis, self.horizon, self.position, self.velocity)
