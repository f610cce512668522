"""Copy, check and measure observations and actions of any space."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Set
from copy import deepcopy
from functools import partial
from typing import Any

import numpy as np
from gymnasium import spaces

from cloudrc.errors import BadInputError

_PLAIN = (int, float, bool, str, np.generic, type(None))


def copied(value: Any) -> Any:
    """Return a copy that no one else changes."""
    if type(value) is np.ndarray:
        return value.copy()
    if isinstance(value, _PLAIN):
        return value
    if type(value) is dict:
        return {key: copied(each) for key, each in value.items()}
    if type(value) is tuple:
        return tuple(copied(each) for each in value)
    return deepcopy(value)


def size_of(value: Any) -> int:
    """Return the size of a value on the wire [bytes], without any framing."""
    if isinstance(value, Mapping):
        return sum(size_of(each) for each in value.values())
    if isinstance(value, tuple | list):
        return sum(size_of(each) for each in value)
    if isinstance(value, str):
        return len(value.encode())
    return int(np.asarray(value).nbytes)


def neutral(space: spaces.Space[Any]) -> Any:
    """Return the action that does nothing: 0, or what is nearest to it in the space."""
    if isinstance(space, spaces.Box):
        return np.clip(np.zeros(space.shape, space.dtype), space.low, space.high)
    if isinstance(space, spaces.Discrete):
        return space.start
    if isinstance(space, spaces.MultiDiscrete):
        return space.start.copy()
    if isinstance(space, spaces.MultiBinary):
        return np.zeros(space.shape, space.dtype)
    if isinstance(space, spaces.Dict):
        return {key: neutral(each) for key, each in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(neutral(each) for each in space.spaces)
    raise BadInputError(
        f"{type(space).__name__} has no neutral action; give start=, the action before the first "
        "answer"
    )


def checker(space: spaces.Space[Any], what: str) -> Callable[[Any], None]:
    """Return a function that raises a BadInputError if an action has another form than the space.

    It does not look at values: the environment decides about them. `what` says in words what an
    action is.
    """
    return partial(_check, _form_of(space), space, what)


# Functions of this module and no closures: an environment that has them can be pickled.
def _check(fits: Callable[[Any], bool], space: spaces.Space[Any], what: str, action: Any) -> None:
    if fits(action):
        return
    shape = getattr(action, "shape", None)
    given = type(action).__name__ + (f" of shape {shape}" if shape is not None else "")
    raise BadInputError(f"the action is {given}; give {what}, in {space}")


def _form_of(space: spaces.Space[Any]) -> Callable[[Any], bool]:
    """Return a function that tells whether an action has the form of a space."""
    if isinstance(space, spaces.Box | spaces.MultiDiscrete | spaces.MultiBinary):
        return partial(_is_array, space.shape)
    if isinstance(space, spaces.Discrete):
        return _is_integer
    if isinstance(space, spaces.Dict):
        return partial(_has_keys, frozenset(space.spaces))
    return _is_given


def _is_array(shape: tuple[int, ...], action: Any) -> bool:
    if type(action) is np.ndarray:
        return bool(action.shape == shape)
    return isinstance(action, list | tuple | np.number) and _shape(action) == shape


def _is_integer(action: Any) -> bool:
    if isinstance(action, np.ndarray):
        return bool(action.shape == ())
    return isinstance(action, int | np.integer)


def _has_keys(keys: Set[str], action: Any) -> bool:
    return isinstance(action, Mapping) and action.keys() == keys


def _is_given(action: Any) -> bool:
    return action is not None


def _shape(action: Any) -> tuple[int, ...] | None:
    try:
        found: tuple[int, ...] = np.shape(action)
        return found
    except ValueError:  # its parts have different lengths
        return None
