"""Check the parameters that an experiment file gives to plug-ins.

The message of a ValueError names the parameter, the value and the reason in one line.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite

from cloudrc.messages import Vector


def not_negative(name: str, value: object) -> float:
    """Return `value` if it is a finite number >= 0, in any unit; else raise ValueError."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{name}: {value!r} is not a number")
    if not isfinite(value) or value < 0:
        raise ValueError(f"{name}: {value!r} must be finite and not negative")
    return float(value)


def positive(name: str, value: object) -> float:
    """Return `value` if it is a finite number > 0, in any unit; else raise ValueError."""
    number = not_negative(name, value)
    if number == 0:
        raise ValueError(f"{name}: {value!r} must be above 0")
    return number


def gain(name: str, value: object) -> float:
    """Return `value` if it is a gain, above 0 and at most 1; else raise ValueError."""
    number = positive(name, value)
    if number > 1:
        raise ValueError(f"{name}: {value!r} must be at most 1")
    return number


def vector(name: str, value: object) -> Vector:
    """Return `value` as a tuple if it has three finite numbers >= 0; else raise ValueError."""
    if isinstance(value, str) or not isinstance(value, Sequence) or len(value) != 3:
        raise ValueError(f"{name}: {value!r} must be three numbers, for x, y and z")
    x, y, z = (
        not_negative(f"{name}[{axis}]", item) for axis, item in zip("xyz", value, strict=True)
    )
    return (x, y, z)
