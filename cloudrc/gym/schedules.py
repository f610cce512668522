# SPDX-License-Identifier: Apache-2.0

"""Choose whose observation leaves next, where several robots share an uplink."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import sqrt
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cloudrc.base.outside.refusal import check_names
from cloudrc.base.outside.values import Quantity, to_arrays
from cloudrc.base.plugins import Found, find, is_path
from cloudrc.gym.values import leaves
from cloudrc.link.draws import BLOCK, Purpose, stream_key, uniforms

KIND = 135
"""Kind of the random numbers with which `random` chooses."""


class Waiting(NamedTuple):
    """An observation that waits for the channel."""

    robot: int
    age: float  # time since `seen` was taken [s]
    change: float  # Euclidean norm of `observation` less `seen`, in their unit [1]
    size: int  # of the message [bytes]
    observation: Any
    seen: Any  # newest observation that the policy has
    actions: tuple[Any, ...]  # executed from the tick of `seen` to before that of `observation`


Choose = Callable[[Sequence[Waiting]], int]
"""Function that returns the place of the one that leaves; they wait in the order of robots."""


def change_of(observation: Any, seen: Any) -> float:
    """Return the Euclidean norm of an observation less another one, over all their numbers."""
    if type(observation) is np.ndarray and observation.dtype.kind == "f":  # the usual case
        part = (observation - seen).ravel()
        return sqrt(part.dot(part))
    both = zip(leaves(observation), leaves(seen), strict=True)
    pairs = [(to_arrays(new), to_arrays(old)) for new, old in both if type(new) is not str]
    parts = [np.subtract(new, old, dtype=float).ravel() for new, old in pairs]
    return sqrt(sum(part.dot(part) for part in parts))


class Schedule:
    """Chooses whose observation leaves in a slot."""

    def begin(self, seed: int, episode: int) -> None:
        """Begin an episode of a channel with its `seed`."""

    def choose(self, waiting: Sequence[Waiting]) -> int:
        """Return the place of the one that leaves."""
        raise NotImplementedError


class RoundRobin(Schedule):
    """The next robot in order that has an observation."""

    def begin(self, seed: int, episode: int) -> None:
        """Begin with the first robot."""
        self._last = -1

    def choose(self, waiting: Sequence[Waiting]) -> int:
        """Return the place of the robot behind the last one."""
        place = next((n for n, each in enumerate(waiting) if each.robot > self._last), 0)
        self._last = waiting[place].robot
        return place


class Random(Schedule):
    """Each robot that waits has the same chance."""

    def begin(self, seed: int, episode: int) -> None:
        """Begin with the first random number of an episode."""
        self._key, self._count = stream_key(seed, True, episode, KIND, "channel"), 0

    def choose(self, waiting: Sequence[Waiting]) -> int:
        """Return a place at random."""
        block, row = divmod(self._count, BLOCK)
        self._count += 1
        return int(uniforms(self._key, Purpose.DELAY, block)[row] * len(waiting))


class Largest(Schedule):
    """The largest value of a field; of equal ones, the first robot."""

    def __init__(self, field: str) -> None:
        self._place = Waiting._fields.index(field)

    def choose(self, waiting: Sequence[Waiting]) -> int:
        """Return the place of the largest value."""
        values = [each[self._place] for each in waiting]
        return values.index(max(values))


class Own(Schedule):
    """What a function of the user chooses, `choose` of a file."""

    def __init__(self, found: Found) -> None:
        self._found = found
        with found.calling("choose"):
            pass  # it is there

    def choose(self, waiting: Sequence[Waiting]) -> int:
        """Return what the function returns."""
        with self._found.calling("choose") as choose:
            return judge(choose(waiting), len(waiting))


class _Function(Schedule):
    """What a function of the program chooses."""

    def __init__(self, choose: Choose) -> None:
        self._choose = choose

    def choose(self, waiting: Sequence[Waiting]) -> int:
        return judge(self._choose(waiting), len(waiting))


def judge(place: Any, count: int) -> int:
    """Return what a user's function has chosen; raise an InvalidValueError if it is no place."""
    chosen: int = Quantity(ge=0, le=count - 1, whole=True).of(place, "the place it returned")
    return chosen


SCHEDULES: dict[str, Callable[[], Schedule]] = {
    "round_robin": RoundRobin,
    "random": Random,
    "largest_age": lambda: Largest("age"),
    "largest_error": lambda: Largest("change"),
}
"""Name of a schedule -> what makes it."""


def find_schedule(given: str | Path | Choose) -> Schedule:
    """Return a schedule by its name, from a file with `choose(waiting)`, or of such a function.

    Raises:
        cloudrc.CloudrcError: If there is none.
    """
    if callable(given):
        return _Function(given)
    name = str(given)
    if is_path(name):
        return Own(find("schedules", name, look=False))
    check_names("schedule", [name], SCHEDULES)
    return SCHEDULES[name]()
