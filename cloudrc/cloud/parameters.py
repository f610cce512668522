"""Check the parameters that an experiment file gives to plug-ins.

The message of a ValueError names the parameter, the value and the reason in one line.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import isfinite
from pathlib import Path
from typing import Any

from cloudrc.config.document import read_document
from cloudrc.errors import CloudrcError
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


def read_model(path: Path | str, wanted: Iterable[str]) -> dict[str, Any]:
    """Return the `wanted` values of a file from `cloudrc identify`; raise ValueError otherwise."""
    try:
        tree = read_document(Path(path), str(path)).tree
    except CloudrcError as error:
        raise ValueError(f"model: {error}; 'cloudrc identify' writes such a file") from error
    if missing := [name for name in wanted if name not in tree]:
        raise ValueError(
            f"model: {path} has no {missing[0]}; 'cloudrc identify' writes a file that has it"
        )
    return {name: tree[name] for name in wanted}
