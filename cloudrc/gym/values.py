# SPDX-License-Identifier: Apache-2.0

"""Copy, check and measure observations and actions of any space."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from copy import deepcopy
from functools import partial
from typing import Any

import numpy as np
from gymnasium import spaces

from cloudrc.base.outside.refusal import naming
from cloudrc.base.outside.values import RESULT, InvalidValueError, shorten, to_arrays

_UNCHANGING = {bool, int, float, str, np.int64, np.float32, np.float64}
"""Types of values that are their own copies."""


def copied(value: Any) -> Any:
    """Return a copy that no one else changes."""
    if type(value) is np.ndarray and not value.dtype.hasobject:  # the usual case: save time
        return value.copy("K")
    if type(value) in _UNCHANGING:
        return value
    if type(value) is dict:
        return {key: copied(each) for key, each in value.items()}
    if type(value) is tuple:
        return tuple(copied(each) for each in value)
    if hasattr(value, "detach"):  # a tensor of PyTorch: none with a gradient can be copied deeply
        return value.detach().clone()
    return deepcopy(value)


def leaves(value: Any) -> Iterator[Any]:
    """Yield what nested mappings, tuples and lists contain, in their order."""
    if isinstance(value, Mapping):
        value = [*value.values()]
    if not isinstance(value, tuple | list):
        yield value
        return
    for each in value:
        yield from leaves(each)


def size_of(value: Any) -> int:
    """Return the size of a value on the wire [bytes], without any framing."""
    return sum(
        len(each.encode()) if isinstance(each, str) else np.asarray(to_arrays(each)).nbytes
        for each in leaves(value)
    )


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
    raise InvalidValueError(
        f"{type(space).__name__} has no neutral action; give start=, the action before the first "
        "answer"
    )


def checker(space: spaces.Space[Any], what: str) -> Callable[[Any], None]:
    """Return a function that raises an error if an action is none of the space.

    It does not look at the bounds of a `Box`: the environment decides about them, and many clip.
    `what` says in words what an action is.
    """
    return partial(_check, space, what)


# A function of this module and no closure: an environment that has it can be pickled.
def _check(space: spaces.Space[Any], what: str, action: Any) -> None:
    try:
        _judge(space, action)
    except (TypeError, ValueError) as error:
        why = f" ({error})" * bool(str(error))
        # Only here: the text of a space takes longer than a step of many an environment.
        with naming("the action", f"{what}, in {space}"):
            raise InvalidValueError(f"it is {shorten(action)}{why}") from None


def _judge(space: spaces.Space[Any], action: Any) -> None:
    """Raise a ValueError if an action does not have the form of a space."""
    if isinstance(space, spaces.Box):
        _measure(space, action)
    elif isinstance(space, spaces.Discrete) and type(action) in (int, np.int64):
        _choose(space, int(action))
    elif isinstance(space, spaces.Dict):
        if not isinstance(action, Mapping) or action.keys() != space.keys():
            raise ValueError
        for key, part in space.items():
            _judge(part, action[key])
    elif isinstance(space, spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary):
        given = np.asarray(action)
        if not space.contains((given.astype(int) if given.dtype == bool else given)[()]):
            raise ValueError
    elif action is None:
        raise ValueError


def _measure(space: spaces.Box, action: Any) -> None:
    """Judge numbers of a box; for a few in an array, take less time."""
    is_array = type(action) is np.ndarray
    if (action.shape if is_array else np.shape(action)) != space.shape:
        raise ValueError
    if not (is_array and RESULT.has_floats(action)):
        RESULT.array(action)


def _choose(space: spaces.Discrete, action: int) -> None:
    """Judge a whole number as `contains` does, in less time."""
    if not 0 <= action - int(space.start) < int(space.n):
        raise ValueError
