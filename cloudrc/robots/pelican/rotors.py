# SPDX-License-Identifier: Apache-2.0

"""The rotors: they turn commanded speeds into thrusts and a drag wrench.

The order of the rotors is always front (+x), left (+y), back, right. The reaction torque about z is
positive for front and back, and negative for left and right.
Source: docs/reference/plant.md, "Robot".
"""

from __future__ import annotations

from math import exp
from typing import TypeAlias

from cloudrc.physics.sim.onboard import Commands
from cloudrc.physics.sim.readings import Readings

THRUST_COEFFICIENT = 9.9865e-6
"""kf: thrust per speed squared [N s^2]."""
TORQUE_RATIO = 0.016
"""km: reaction torque about the rotor's axis per thrust [m]."""
SPEED_MAX = 1838.0
"""Largest rotor speed [rad/s]."""
TIME_CONSTANT_UP, TIME_CONSTANT_DOWN = 0.0125, 0.025
"""Time constants with which a rotor speeds up and slows down [s]."""
DRAG_COEFFICIENT = 8.06428e-5
"""Drag force per rotor speed and per velocity across the rotor's axis [N s^2/m]."""
ARM = 0.21
"""Distance of a rotor's axis from the base's z axis [m]."""
HEIGHT = 0.05
"""Height of the rotors above the base's origin [m]."""

RotorSpeeds: TypeAlias = tuple[float, float, float, float]
"""Speeds of the front, left, back and right rotor [rad/s], >= 0."""
STOPPED: RotorSpeeds = (0.0, 0.0, 0.0, 0.0)

_DRAG_ARM = DRAG_COEFFICIENT * ARM
_ARM_SQUARED = ARM * ARM

RotorInputs: TypeAlias = tuple[float, float, float, float, float, float, float, float, float, float]
"""Input to MuJoCo: four thrusts [N], then the drag at the base's origin as a force in the world
frame [N] and a torque in the body frame [N m], as MuJoCo's free joint requires."""


class Rotors:
    """Four rotors with lag, thrust and drag; `speeds` are front, left, back, right [rad/s].

    In one step, the speed of a rotor changes by a share [1] of its difference from the commanded
    speed. The share is `up` for a rotor that speeds up, `down` for a rotor that slows down.
    """

    def __init__(self, dt: float) -> None:
        """Begin with stopped rotors; `dt` is the duration of a step [s]."""
        self.up = 1.0 - exp(-dt / TIME_CONSTANT_UP)
        self.down = 1.0 - exp(-dt / TIME_CONSTANT_DOWN)
        self.speeds: Commands = STOPPED

    def reset(self) -> None:
        """Stop all rotors."""
        self.speeds = STOPPED

    def step(self, commands: Commands, readings: Readings) -> RotorInputs:
        """Advance the rotor speeds by one step towards `commands`; return thrusts and drag.

        Lag: w(t + dt) = w + (command - w) · (1 - exp(-dt/T)), with T = 12.5 ms for a rotor that
        speeds up, 25 ms for a rotor that slows down. Thrust: kf · w^2.
        Drag: at each rotor F = -w · c · vh, where vh is the hub's velocity across the rotor's axis.
        With body velocity (u, v, .), rates (p, q, r) and a hub at (x, y, h), vh is (u + q · h - r ·
        y, v + r · x - p · h). The hubs have x = (l, 0, -l, 0), y = (0, l, 0, -l).
        The sum of r x F over the hubs is the torque (-h · Fy, h · Fx, sum of x · Fy - y · Fx).
        Source: docs/reference/plant.md, "Rotor speed", "Rotor drag".
        """
        up, down, k = self.up, self.down, THRUST_COEFFICIENT
        front, left, back, right = self.speeds
        to_front, to_left, to_back, to_right = commands
        front += (to_front - front) * (up if to_front > front else down)
        left += (to_left - left) * (up if to_left > left else down)
        back += (to_back - back) * (up if to_back > back else down)
        right += (to_right - right) * (up if to_right > right else down)
        self.speeds = (front, left, back, right)

        _, _, (vx, vy, vz), (p, q, r), (xx, xy, xz, yx, yy, yz, _, _, _) = readings
        total = DRAG_COEFFICIENT * (front + left + back + right)
        across_x = _DRAG_ARM * (front - back)
        across_y = _DRAG_ARM * (left - right)
        u = xx * vx + xy * vy + xz * vz + q * HEIGHT
        v = yx * vx + yy * vy + yz * vz - p * HEIGHT
        force_x = across_y * r - total * u
        force_y = -across_x * r - total * v
        return (
            k * front * front,
            k * left * left,
            k * back * back,
            k * right * right,
            xx * force_x + yx * force_y,
            xy * force_x + yy * force_y,
            xz * force_x + yz * force_y,
            -HEIGHT * force_y,
            HEIGHT * force_x,
            across_y * u - across_x * v - _ARM_SQUARED * total * r,
        )
