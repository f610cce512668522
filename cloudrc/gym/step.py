# SPDX-License-Identifier: Apache-2.0

"""Find the time of a step of an environment, and who tells it."""

from __future__ import annotations

import dis
from collections.abc import Iterator, Mapping
from math import isnan, nan, remainder
from typing import Any, NamedTuple

import gymnasium
from gymnasium.vector import AsyncVectorEnv, VectorWrapper

from cloudrc.base.outside.values import ANY, InvalidValueError

CONTROL = ("step_dt", "control_hz", "control_freq", "policy_frequency")
"""Names that tell how often an environment takes an action, as in Isaac Lab, gym-pusht, robosuite,
ManiSkill and highway-env."""
TIMES = ("step_dt", "dt", "tau")
"""Names of times [s]; all others are rates [1/s]."""
FRAME_ROUNDING = 0.12
"""How far the number of steps in a frame may be from a whole one: rates of frames are rounded."""
FILM = ", a film's rate"
"""End of the words for a time that is that of a frame."""
WAY = "give dt=, the time of a step in seconds"


class StepTime(NamedTuple):
    """The time of a step of an environment."""

    seconds: float  # time of a step [s]
    source: str  # who tells it

    def __str__(self) -> str:
        return f"{self.seconds:.4g} s ({self.source})"


def find_step(env: Any, given: float | None) -> StepTime:
    """Return the time of a step of an environment, or of the first of a vector, unless `given` [s].

    What tells control is preferred to `dt` and `tau`, and these to the rate of a film. Raise an
    InvalidValueError if nothing tells the time of a step, or if what tells it may mean a part of a
    step.
    """
    if given is not None:
        if isnan(time := _seconds("dt", given)):
            raise InvalidValueError(f"the environment has the time step {given!r}; {WAY}")
        return StepTime(time, "given")
    *wrappers, bare = layers(env)
    if isinstance(bare, AsyncVectorEnv):
        raise InvalidValueError(
            f"environments in other processes do not tell their time step; {WAY}"
        )
    who = type(bare.unwrapped).__name__
    for each in filter(_repeats, wrappers):
        raise InvalidValueError(f"a step of {type(each).__name__} is several steps of {who}; {WAY}")
    told = _told(bare)
    name, time = next(iter(told.items()), ("", nan))
    if isnan(time):
        raise InvalidValueError(f"the environment {who} has no time step; {WAY}")
    frame = told.get("render_fps", nan)
    frames = frame / time
    if name in ("dt", "tau") and frames > 1.5 and abs(remainder(frames, 1.0)) < FRAME_ROUNDING:
        raise InvalidValueError(
            f"{who}: {name} says {time:.4g} s, render_fps says {frame:.4g} s; {WAY}"
        )
    return StepTime(time, f"{name} of {who}" + FILM * (name == "render_fps"))


def layers(env: Any) -> Iterator[Any]:
    """Yield the wrappers of an environment, of a vector also those of its first one, and itself."""
    if isinstance(env, gymnasium.Wrapper | VectorWrapper):
        yield env
        yield from layers(env.env)
    elif getattr(env, "envs", None):
        yield from layers(env.envs[0])
    else:
        yield env


def _told(env: Any) -> dict[str, float]:
    """Return what an environment says about the time of a step [s]: the best name is the first.

    NaN stands for a value that is no time.
    """
    base = env.unwrapped
    config = getattr(base, "config", None)
    config = config if isinstance(config, Mapping) else {}
    found = {name: getattr(base, name, config.get(name)) for name in CONTROL}
    found |= {name: getattr(base, name, None) for name in ("dt", "tau")}
    found["render_fps"] = (env.metadata or {}).get("render_fps") or None
    return {name: _seconds(name, value) for name, value in found.items() if value is not None}


def _seconds(name: str, value: Any) -> float:
    """Return the time [s] that a value means; NaN if it means none."""
    try:
        number = ANY.of(value)
        number = number if name in TIMES else 1.0 / number
    except (InvalidValueError, ZeroDivisionError):
        return nan
    return number if 0.0 < number <= 3600.0 else nan


def _repeats(wrapper: Any) -> bool:
    """Return whether a wrapper makes several steps of one: it skips frames, or has a loop."""
    named = [each for name, each in vars(wrapper).items() if "skip" in name or "repeat" in name]
    return any(type(each) is int and each > 1 for each in named) or _loops(wrapper)


def _loops(wrapper: Any) -> bool:
    """Return whether the `step` of a user's wrapper calls another `step` in a loop.

    Wrappers of gymnasium name the frames that they skip. The code is looked at in place of the
    text, which Python does not have of classes that were typed or piped into it.
    """
    step = type(wrapper).step
    if step.__module__.startswith("gymnasium.") or not hasattr(step, "__code__"):
        return False
    code = [*dis.get_instructions(step)]
    calls = [each.offset for each in code if each.argval == "step"]
    backward = [each for each in code if "JUMP_BACKWARD" in each.opname]
    return any(jump.argval <= at < jump.offset for jump in backward for at in calls)
