# SPDX-License-Identifier: Apache-2.0

"""The twins in C of the onboard controllers for any robot of their kind."""

from __future__ import annotations

import ctypes
from math import inf
from typing import TYPE_CHECKING

from cloudrc.physics.sim.simulator import Simulator
from cloudrc.robots.native.robot import ACTUATORS_MAX, Twin
from cloudrc.robots.onboard._drag import RotorDrag

if TYPE_CHECKING:
    from cloudrc.robots.onboard.diff_drive import DiffDrive
    from cloudrc.robots.onboard.multirotor import Multirotor

_double, _int64 = ctypes.c_double, ctypes.c_int64


class _Multirotor(ctypes.Structure):
    """The C structure `Multirotor`; `multirotor.c` explains its fields."""

    _fields_ = (
        ("numbers", _double * 26),
        *((name, _int64) for name in ("count", "drags", "tilted")),
        ("columns", _double * 4 * ACTUATORS_MAX),
        ("limits", _double * 2 * ACTUATORS_MAX),
        ("rotors", _double * 7 * ACTUATORS_MAX),
        ("memory", _double * 9),
    )


class MultirotorTwin(Twin):
    """The twin of `Multirotor`, with MuJoCo's actuators or with the drag of rotors."""

    control = "multirotor"

    def __init__(self, simulator: Simulator, onboard: Multirotor) -> None:
        self._onboard, self.acceleration_max = onboard, onboard.acceleration_max
        self.block = block = _Multirotor(onboard.numbers, len(onboard.stopped))
        allocation, actuators = onboard.allocation, simulator.actuators
        for row, column in enumerate(allocation.columns):
            block.columns[row] = column
        for row, limits in enumerate(allocation.limits):
            block.limits[row] = limits
        if isinstance(actuators, RotorDrag):
            block.drags, block.tilted = True, bool(actuators.tilted)
            upright = [(x, y, z, 0.0, 0.0, 1.0, drag) for x, y, z, drag in actuators.upright]
            for row, rotor in enumerate(actuators.tilted or upright):
                block.rotors[row] = rotor

    def give(self) -> bool:
        """Write the controller's memory to the block; return whether it has one."""
        memory = self._onboard.memory
        if memory is not None:
            self.block.memory = memory
        return memory is not None

    def take(self) -> None:
        """Read the controller's memory from the block."""
        self._onboard.memory = tuple(self.block.memory)


class _DiffDrive(ctypes.Structure):
    """The C structure `DiffDrive`; `diff_drive.c` explains its fields."""

    _fields_ = (
        ("numbers", _double * 7),
        ("count", _int64),
        ("wheels", _double * 2 * ACTUATORS_MAX),
        ("lead", _double),
    )


class DiffDriveTwin(Twin):
    """The twin of `DiffDrive`, with MuJoCo's actuators; the robot always touches the ground."""

    control = "diff_drive"
    acceleration_max = inf

    def __init__(self, simulator: Simulator, onboard: DiffDrive) -> None:
        self._onboard = onboard
        self.block = _DiffDrive(onboard.numbers, len(onboard.wheels))
        for row, wheel in enumerate(onboard.wheels):
            self.block.wheels[row] = wheel

    def give(self) -> bool:
        """Write the controller's memory to the block; return whether it has one."""
        self.block.lead = self._onboard.lead
        return True

    def take(self) -> None:
        """Read the controller's memory from the block."""
        self._onboard.lead = self.block.lead
