"""The memory that Python and `step.c` share: numbers, MuJoCo's addresses and the present state."""

from __future__ import annotations

import ctypes
from math import prod
from pathlib import Path
from typing import Any

from cloudrc.geometry.fence import FLOOR_MARGIN
from cloudrc.messages import NEVER_NS
from cloudrc.world import low_level, rotors
from cloudrc.world.guard import limits as rules
from cloudrc.world.guard import state
from cloudrc.world.scene import mujoco
from cloudrc.world.simulator import Simulator

POINTERS = ("mj_step", "model", "data", "qpos", "qvel", "ctrl", "applied", "contacts")
NUMBERS: dict[str, float] = {
    "thrust_coefficient": rotors.THRUST_COEFFICIENT,
    "drag_coefficient": rotors.DRAG_COEFFICIENT,
    "drag_arm": rotors.DRAG_COEFFICIENT * rotors.ARM,
    "arm_squared": rotors.ARM * rotors.ARM,
    "height": rotors.HEIGHT,
    "up": 0.0,
    "down": 0.0,
    "weight": low_level.MASS * low_level.GRAVITY,
    "tiny": low_level.TINY,
    "half_tilt_gain": 0.5 * low_level.TILT_GAIN,
    "half_yaw_gain": 0.5 * low_level.YAW_GAIN,
    "tilt_rate_gain": low_level.TILT_RATE_GAIN,
    "yaw_rate_gain": low_level.YAW_RATE_GAIN,
    "two_arms": 2.0 * rotors.ARM,
    "four_ratios": 4.0 * rotors.TORQUE_RATIO,
    "thrust_max": low_level.THRUST_MAX,
    "nose_cosine_min": low_level.NOSE_COSINE_MIN,
    "yaw_sine_max": low_level.YAW_SINE_MAX,
}
"""Numbers of rotors and low-level controller, in the units of their modules."""
GUARD_NUMBERS: dict[str, float] = {
    "overturned_cosine": state.OVERTURNED_COSINE,
    "change_max": 0.0,
    "sink_lead_max": rules.SINK_LEAD_MAX,
    "fence_reaction": rules.FENCE_REACTION,
    "reaction": rules.REACTION,
    "stop_coefficient": rules.STOP_COEFFICIENT,
    "recheck_distance": rules.RECHECK_DISTANCE,
    "far": rules.FAR,
    "low_z": 0.0,
}
"""Numbers of the guard, likewise."""

_double, _int64 = ctypes.c_double, ctypes.c_int64
_vector = _double * 3


class Flight(ctypes.Structure):
    """The structure `Flight` of `step.c`, which explains the fields."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in POINTERS),
        *((name, _double) for name in NUMBERS),
        *(("gains", _double * 9), ("limit_xy", _double), ("limit_z", _double), ("dt", _double)),
        *((name, _double) for name in GUARD_NUMBERS),
        *(("low", _vector), ("high", _vector)),
        *((name, _int64) for name in ("recheck_ns", "never_ns", "step_ns")),
        *(("reference", _vector), ("wanted", _vector), ("settled", _int64)),
        *(("steady_until_ns", _int64), ("track_until_ns", _int64)),
        *(("speeds", _double * 4), ("integral", _vector), ("error", _vector)),
        *(("has_error", _int64), ("before", _double * 13)),
    )


def make_flight(
    simulator: Simulator, controller: low_level.LowLevel, limits: rules.Limits, step_ns: int
) -> Flight:
    """Fill everything but the state; `step_ns` is the duration of a step [ns].

    Raise an OSError, AttributeError, KeyError or ImportError if MuJoCo is not as expected.
    """
    model, data = simulator.model, simulator.data
    arrays = data.qpos, data.qvel, data.ctrl, data.qfrc_applied
    limit_xy, limit_z, dt = controller.limits
    low, high = limits.inner_corners()
    turning = rotors.Rotors(simulator.dt)
    known = {**NUMBERS, **GUARD_NUMBERS, "up": turning.up, "down": turning.down}
    known["change_max"] = limits.acceleration_max * (step_ns * 1e-9)
    known["low_z"] = low[2] - FLOOR_MARGIN + rules.LOW_HEIGHT
    return Flight(
        ctypes.cast(mujoco_library().mj_step, ctypes.c_void_p),
        *(model._address, data._address),  # the only way to these addresses
        *(array.ctypes.data for array in arrays),
        data._address + contacts_offset(),
        **known,
        gains=controller.gains,
        **{"limit_xy": limit_xy, "limit_z": limit_z, "dt": dt, "low": low, "high": high},
        **{"recheck_ns": rules.RECHECK_NS, "never_ns": NEVER_NS, "step_ns": step_ns},
    )


def mujoco_library() -> ctypes.CDLL:
    """Return MuJoCo's own library, which `import mujoco` has loaded."""
    folder = Path(mujoco.__file__).parent
    names = ("libmujoco.so*", "libmujoco*.dylib", "mujoco.dll")
    files = [file for name in names for file in folder.glob(name)]
    if len(files) != 1:
        raise OSError(f"{folder}: has {len(files)} files of MuJoCo's library, not 1")
    return ctypes.CDLL(str(files[0]))


def contacts_offset() -> int:
    """Return where `ncon`, the number of contacts, is in `mjData` [bytes].

    The place depends on MuJoCo's version; the package describes its own structures.
    """
    from mujoco.introspect import structs

    fields = []
    for field in structs.STRUCTS["mjData"].fields:
        fields.append((field.name, _ctype(field.type, structs.STRUCTS)))
        if field.name == "ncon":
            break
    layout: Any = type("mjData", (ctypes.Structure,), {"_fields_": fields})
    offset: int = layout.ncon.offset
    return offset


_SCALARS = {
    **{"int": ctypes.c_int, "float": ctypes.c_float, "mjtNum": _double, "double": _double},
    **{"mjtBool": ctypes.c_uint8, "mjtByte": ctypes.c_uint8, "mjtSize": _int64},
    **{"size_t": _int64, "uintptr_t": _int64, "uint64_t": _int64, "mjtTimer": ctypes.c_int},
}


def _ctype(kind: Any, structs: Any) -> Any:
    """Return the type of ctypes for a type of `mujoco.introspect`; KeyError if it is unknown."""
    if hasattr(kind, "extents"):
        return _ctype(kind.inner_type, structs) * prod(kind.extents)
    if not hasattr(kind, "name"):
        return ctypes.c_void_p
    if kind.name in _SCALARS:
        return _SCALARS[kind.name]
    fields = [(field.name, _ctype(field.type, structs)) for field in structs[kind.name].fields]
    return type(kind.name, (ctypes.Structure,), {"_fields_": fields})
