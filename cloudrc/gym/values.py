"""Copy, check and measure observations and actions of any space."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import deepcopy
from functools import partial
from typing import Any

import numpy as np
from gymnasium import spaces

from cloudrc.errors import BadInputError
from cloudrc.plugins import LARGEST, InvalidResultError, shorten, to_arrays, to_numbers

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
    if hasattr(value, "detach"):  # a tensor of PyTorch: none with a gradient can be copied deeply
        return value.detach().clone()
    return deepcopy(value)


def size_of(value: Any) -> int:
    """Return the size of a value on the wire [bytes], without any framing."""
    if isinstance(value, Mapping):
        return sum(size_of(each) for each in value.values())
    if isinstance(value, tuple | list):
        return sum(size_of(each) for each in value)
    if isinstance(value, str):
        return len(value.encode())
    return int(np.asarray(to_arrays(value)).nbytes)


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
    """Return a function that raises a BadInputError if an action is none of the space.

    It does not look at the bounds of a `Box`: the environment decides about them, and many clip.
    `what` says in words what an action is.
    """
    return partial(_check, _judge_of(space), space, what)


# Functions of this module and no closures: an environment that has them can be pickled.
def _check(judge: Callable[[Any], None], space: spaces.Space[Any], what: str, action: Any) -> None:
    try:
        judge(action)
    except (InvalidResultError, TypeError, ValueError) as error:
        shape = getattr(action, "shape", None)
        given = shorten(action) + (f" of shape {shape}" if shape is not None else "")
        why = f" ({error})" if isinstance(error, InvalidResultError) else ""
        raise BadInputError(f"the action is {given}{why}; give {what}, in {space}") from None


def _judge_of(space: spaces.Space[Any]) -> Callable[[Any], None]:
    """Return a function that raises a ValueError if an action does not have the form of a space."""
    if isinstance(space, spaces.Box):
        return partial(_judge_array, space.shape)
    if isinstance(space, spaces.MultiDiscrete | spaces.MultiBinary):
        return partial(_judge_choices, space)
    if isinstance(space, spaces.Discrete):
        return partial(_judge_choice, int(space.start), int(space.start + space.n))
    if isinstance(space, spaces.Dict):
        return partial(_judge_map, {key: _judge_of(each) for key, each in space.spaces.items()})
    return _judge_given


def _judge_array(shape: tuple[int, ...], action: Any, *, may_switch: bool = False) -> None:
    if type(action) is np.ndarray and action.shape == shape:
        if action.dtype.kind == "f" and float(np.vdot(action, action)) <= LARGEST:
            return  # the usual case: `to_numbers` takes microseconds
    elif not isinstance(action, list | tuple | np.generic) or np.shape(action) != shape:
        raise ValueError
    if not (may_switch and np.asarray(action).dtype.kind == "b"):
        to_numbers(action)


def _judge_choices(space: spaces.MultiDiscrete | spaces.MultiBinary, action: Any) -> None:
    _judge_array(space.shape, action, may_switch=True)
    if not space.contains(np.asarray(action)):
        raise ValueError


def _judge_choice(first: int, end: int, action: Any) -> None:
    if type(action) is not int and (
        np.shape(action) != () or np.asarray(action).dtype.kind not in "biu"
    ):
        raise ValueError
    if not first <= int(action) < end:
        raise ValueError


def _judge_map(judges: Mapping[str, Callable[[Any], None]], action: Any) -> None:
    if not isinstance(action, Mapping) or action.keys() != judges.keys():
        raise ValueError
    for key, judge in judges.items():
        judge(action[key])


def _judge_given(action: Any) -> None:
    if action is None:
        raise ValueError
