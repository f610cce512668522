# SPDX-License-Identifier: Apache-2.0

"""The twin in C of the Pelican's controller and rotors."""

from __future__ import annotations

import ctypes
from struct import Struct
from typing import Any

from cloudrc.physics.sim.simulator import Simulator
from cloudrc.robots.native.robot import Twin
from cloudrc.robots.pelican import low_level, rotors
from cloudrc.robots.pelican.low_level import LowLevel

_CONSTANTS = {
    rotors: "thrust_coefficient torque_ratio drag_coefficient arm height",
    low_level: "mass gravity tilt_gain yaw_gain tilt_rate_gain yaw_rate_gain "
    "thrust_max tiny nose_cosine_min yaw_sine_max",
}
"""Modules and their constants that `low_level.c` needs, in the order of its fields."""
_VALUES = {
    name: getattr(module, name.upper())
    for module, names in _CONSTANTS.items()
    for name in names.split()
}
_double = ctypes.c_double
_FIELDS: dict[str, Any] = {
    **dict.fromkeys([*_VALUES, "up", "down"], _double),
    **{"gains": _double * 9, "limit_xy": _double, "limit_z": _double, "dt": _double},
    **{"integral": _double * 3, "error": _double * 3, "has_error": ctypes.c_int64},
}


class _LowLevel(ctypes.Structure):
    """The C structure `LowLevel`; `low_level.c` explains its fields."""

    _fields_ = tuple(_FIELDS.items())


_MEMORY = _LowLevel.integral.offset
_pack_memory, _unpack_memory = Struct("6dq").pack_into, Struct("6d").unpack_from


class PelicanTwin(Twin):
    """The twin of `LowLevel` and `Rotors`."""

    control = "low_level"
    # Full thrust gives a robot that is 10 % lighter 153 m/s^2, and a spin of 50 rad/s about a
    # centre of mass 3 cm away gives 75 m/s^2.
    acceleration_max = 400.0

    def __init__(self, simulator: Simulator, onboard: LowLevel) -> None:
        self._onboard, turning = onboard, rotors.Rotors(simulator.dt)
        ways = turning.up, turning.down
        self.block = _LowLevel(*_VALUES.values(), *ways, onboard.gains, *onboard.limits)

    def give(self) -> bool:
        """Write the controller's memory to the block; return whether it has one."""
        integral, error = self._onboard.integral, self._onboard.error
        _pack_memory(self.block, _MEMORY, *integral, *(error or integral), error is not None)
        return True

    def take(self) -> None:
        """Read the controller's memory from the block."""
        numbers = _unpack_memory(self.block, _MEMORY)
        self._onboard.integral, self._onboard.error = numbers[:3], numbers[3:]
