# SPDX-License-Identifier: Apache-2.0

"""Drag of the rotors of any multirotor, which MuJoCo does not simulate."""

from __future__ import annotations

from typing import Any

import numpy as np

from cloudrc.physics.sim.airframe import read_thrusters
from cloudrc.physics.sim.onboard import Commands, Direct, Inputs
from cloudrc.physics.sim.readings import Readings


class RotorDrag(Direct):
    """Actuators that MuJoCo simulates, with rotors whose drag is added.

    Attributes:
        upright: Place of each rotor [m], and its drag per control and velocity, if all rotors push
            along z alone, else nothing.
        tilted: Place [m], axis and drag of each rotor, if some push in other directions.
    """

    def __init__(self, model: Any, drag: float) -> None:
        """Read the rotors from a compiled `MjModel`.

        `drag` is the drag force relative to the thrust and to the velocity [s/m].
        """
        super().__init__(model.nu)
        # Place of each rotor, its axis, and its drag per control and velocity.
        rotors: list[tuple[float, ...]] = []
        places, forces = read_thrusters(model)
        for place, force in zip(places, forces, strict=True):
            thrust = float(np.linalg.norm(force))
            axis = force / thrust if thrust else force
            rotors.append((*place.tolist(), *axis.tolist(), drag * thrust))
        # All rotors are in one of the two lists: those of most robots push along z alone.
        self.upright = [(x, y, z, drag) for x, y, z, *_, drag in rotors]
        self.tilted = list[tuple[float, ...]]()
        if any(rotor[3:6] != (0.0, 0.0, 1.0) for rotor in rotors):
            self.upright, self.tilted = [], rotors

    def step(self, commands: Commands, readings: Readings) -> Inputs:
        """Return the commands, and the drag as a force [N] and a torque [N m].

        At each rotor F = -drag · |T| · vh, where T is the commanded thrust, and vh the velocity of
        the hub relative to the air, across the rotor's axis. The torque is the sum of r x F.
        """
        self.speeds = commands
        _, _, (vx, vy, vz), (p, q, r), (xx, xy, xz, yx, yy, yz, zx, zy, zz) = readings
        u = xx * vx + xy * vy + xz * vz
        v = yx * vx + yy * vy + yz * vz
        w = zx * vx + zy * vy + zz * vz
        force_x = force_y = force_z = torque_x = torque_y = torque_z = 0.0
        for command, (x, y, z, drag) in zip(commands, self.upright, strict=False):
            scale = -drag * abs(command)  # without the part along the axis, which is 0
            fx, fy = scale * (u + q * z - r * y), scale * (v + r * x - p * z)
            force_x += fx
            force_y += fy
            torque_x -= z * fy
            torque_y += z * fx
            torque_z += x * fy - y * fx
        for command, (x, y, z, ax, ay, az, drag) in zip(commands, self.tilted, strict=False):
            hub_x, hub_y, hub_z = u + q * z - r * y, v + r * x - p * z, w + p * y - q * x
            along = hub_x * ax + hub_y * ay + hub_z * az
            scale = -drag * abs(command)
            fx = scale * (hub_x - along * ax)
            fy = scale * (hub_y - along * ay)
            fz = scale * (hub_z - along * az)
            force_x += fx
            force_y += fy
            force_z += fz
            torque_x += y * fz - z * fy
            torque_y += z * fx - x * fz
            torque_z += x * fy - y * fx
        return (
            *commands,
            xx * force_x + yx * force_y + zx * force_z,
            xy * force_x + yy * force_y + zy * force_z,
            xz * force_x + yz * force_y + zz * force_z,
            torque_x,
            torque_y,
            torque_z,
        )
