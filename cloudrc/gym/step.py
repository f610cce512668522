"""Find the time of a step of an environment, and who tells it."""

from __future__ import annotations

import dis
from collections.abc import Iterator, Mapping
from contextlib import suppress
from math import isnan, log10, nan, remainder
from types import CodeType
from typing import Any, NamedTuple

import gymnasium
from gymnasium.vector import AsyncVectorEnv, VectorWrapper

from cloudrc.gym.options import compute_times
from cloudrc.outside.values import ANY, InvalidValueError

CONTROL = ("step_dt", "control_hz", "control_freq", "policy_frequency")
"""Names that tell how often an environment takes an action, as in Isaac Lab, gym-pusht, robosuite,
ManiSkill and highway-env."""
TIMES = ("step_dt", "dt", "tau")
"""Names of times [s]; all others are rates [1/s]."""
DIFFERENCE = 0.05
"""Relative difference from which on two times of a step differ."""
FRAME_ROUNDING = 0.12
"""How far the number of steps in a frame may be from a whole one: rates of frames are rounded."""
SLOW_STEPS = 100
"""Number of steps of an environment after which an answer is slow enough for a warning."""
WAY = "give dt=, the time of a step in seconds"


class StepTime(NamedTuple):
    """The time of a step of an environment."""

    seconds: float  # time of a step [s]
    source: str  # who tells it
    doubts: list[str]  # warnings, each begins with the name of an argument

    def __str__(self) -> str:
        return f"{self.seconds:.4g} s ({self.source})"


def find_step(
    env: Any, given: float | None, compute: float | tuple[float, float] = 0.0
) -> StepTime:
    """Return the time of a step of an environment, or of the first of a vector, unless `given` [s].

    What tells control is preferred to `dt` and `tau`, and these to the rate of a film. `compute` is
    the time for an answer [s], or its mean and its deviation. Raise an InvalidValueError if nothing
    tells the time of a step, or if what tells it may mean a part of a step.
    """
    *wrappers, bare = _layers(env)
    told = _told(bare)
    if given is None:
        time, source = _own_step(wrappers, bare, told)
    elif isnan(time := _seconds("dt", given)):
        raise InvalidValueError(f"the environment has the time step {given!r}; {WAY}")
    else:
        source = "given"
    found, (mean, _) = list[str](), compute_times(compute)
    known = [each for each in told.values() if not isnan(each)]
    # A step of 10 times what the environment tells, or of a tenth, may have another unit.
    if known and all(abs(log10(time / each)) >= 1.0 for each in known):
        found.append(
            f"dt: a step of {time:g} s, but the environment says {known[0]:.3g} s; the unit is s"
        )
    if mean > SLOW_STEPS * time:
        found.append(
            f"compute: an answer takes {mean:g} s, as long as {mean / time:,.0f} steps of the "
            "environment; the unit is s"
        )
    return StepTime(time, source, found)


def _own_step(wrappers: list[Any], bare: Any, told: Mapping[str, float]) -> tuple[float, str]:
    """Return the time of a step that an environment tells [s], and by which name."""
    if isinstance(bare, AsyncVectorEnv):
        raise InvalidValueError(
            f"environments in other processes do not tell their time step; {WAY}"
        )
    who = type(bare.unwrapped).__name__
    for each in filter(_repeats, wrappers):
        raise InvalidValueError(f"a step of {type(each).__name__} is several steps of {who}; {WAY}")
    name, time = next(iter(told.items()), ("", nan))
    if isnan(time):
        raise InvalidValueError(f"the environment {who} has no time step; {WAY}")
    own, frames = told.get("dt", nan), told.get("render_fps", nan) / time
    longer = [each for each in CONTROL if abs(told.get(each, nan) / own - 1.0) > DIFFERENCE]
    if name in ("dt", "tau") and frames > 1.5 and abs(remainder(frames, 1.0)) < FRAME_ROUNDING:
        longer.append("render_fps")
    if longer:
        all_told = ", ".join(f"{name} says {time:.4g} s" for name, time in told.items())
        raise InvalidValueError(f"{who}: {all_told}; {WAY}; it may be {told[longer[0]]:.4g}")
    return time, f"{name} of {who}" + ", a film's rate" * (name == "render_fps")


def _layers(env: Any) -> Iterator[Any]:
    """Yield the wrappers of an environment, of a vector also those of its first one, and itself."""
    if isinstance(env, gymnasium.Wrapper | VectorWrapper):
        yield env
        yield from _layers(env.env)
    elif getattr(env, "envs", None):
        yield from _layers(env.envs[0])
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
    with suppress(InvalidValueError, ZeroDivisionError):
        number = ANY.of(value)
        number = number if name in TIMES else 1.0 / number
        return number if 0.0 < number <= 3600.0 else nan
    return nan


def _repeats(wrapper: Any) -> bool:
    """Return whether a wrapper makes several steps of one: it calls `step` in a loop.

    It does so once if it names a number of repetitions or skipped frames that is 1.
    """
    named = [each for name, each in vars(wrapper).items() if "skip" in name or "repeat" in name]
    if any(type(each) is int and each == 1 for each in named):
        return False
    steps = [getattr(vars(kind).get("step"), "__code__", None) for kind in type(wrapper).__mro__]
    return any(_loops(code) for code in steps if code)


def _loops(code: CodeType) -> bool:
    """Return whether code, or a comprehension in it, calls a `step` in a loop."""
    if any(_loops(each) for each in code.co_consts if isinstance(each, CodeType)):
        return True
    found = [*dis.get_instructions(code)]
    calls = [each.offset for each in found if each.argval == "step"]
    jumps = [each for each in found if "JUMP" in each.opname]
    return any(jump.argval <= call <= jump.offset for jump in jumps for call in calls)
