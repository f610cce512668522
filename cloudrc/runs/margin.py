"""Find the values of a key at which a question is answered with yes, such as "is the loop stable?".

All values are multiples of a resolution, so that the search is over whole numbers. A coarse grid
comes first, because the answer may change more than once. Then each end of the range around the
present value is bisected.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any, Literal, NamedTuple, TypeAlias, get_args, get_origin

from cloudrc.ages import simulate_ages
from cloudrc.config.problems import exceeds, expectation
from cloudrc.config.profile import COMMAND_AGE_MS
from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.config.schema import Experiment
from cloudrc.errors import BadInputError
from cloudrc.outside.document import child
from cloudrc.robots.build import onboard_values

SLACK = 0.1
"""Reserve between the largest age of `simulate_ages` and the limits of cloud and guard [s]."""
LIMIT_MAX = COMMAND_AGE_MS[1] * 1e-3
"""Largest value of each of these limits [s]."""
STEPS_MAX = 32
"""Default of the largest value to try, as a multiple of the first value."""
Works: TypeAlias = Callable[[int], bool]


class ValueRange(NamedTuple):
    """The range of numbers around the present one for which the answer is yes.

    A number that does not exist is None: `first` and `last` if the answer is never yes, `below` and
    `above` if the range reaches the end of the search.
    """

    first: int | None
    last: int | None
    below: int | None  # largest number below the range for which the answer is no
    above: int | None  # smallest number above the range for which the answer is no
    elsewhere: list[tuple[int, int]]  # further ranges of the grid, first and last number


def grid(present: int, bottom: int, top: int) -> list[int]:
    """Return numbers from `bottom` to `top`: the ends, `present`, and its doubles and halves."""
    numbers, step = {bottom, present, top}, present
    while step < top:
        step *= 2
        numbers.add(min(step, top))
    step = present
    while step > bottom:
        step //= 2
        numbers.add(max(step, bottom))
    return sorted(numbers)


def search(works: Works, present: int, bottom: int, top: int) -> ValueRange:
    """Find the range of whole numbers in which `works` is true, from `bottom` to `top`.

    The range is the one with `present`, or that nearest to it. Inside the range, only
    the numbers of the grid and of the bisection are tried.
    """
    numbers = grid(present, bottom, top)
    answers = [works(number) for number in numbers]
    runs = _runs(answers)
    if not runs:
        return ValueRange(None, None, None, numbers[0], [])
    at = numbers.index(present)
    run = min(runs, key=lambda each: max(each[0] - at, at - each[1], 0))
    first, last, below, above = numbers[run[0]], numbers[run[1]], None, None
    if run[0] > 0:
        first, below = bisect(works, first, numbers[run[0] - 1])
    if run[1] < len(numbers) - 1:
        last, above = bisect(works, last, numbers[run[1] + 1])
    elsewhere = [(numbers[a], numbers[b]) for a, b in runs if (a, b) != run]
    return ValueRange(first, last, below, above, elsewhere)


def _runs(answers: list[bool]) -> list[tuple[int, int]]:
    """Return the first and the last index of each group of neighbours that are true."""
    runs = list[tuple[int, int]]()
    for index, answer in enumerate(answers):
        if answer and index and answers[index - 1]:
            runs[-1] = runs[-1][0], index
        elif answer:
            runs.append((index, index))
    return runs


def bisect(works: Works, yes: int, no: int) -> tuple[int, int]:
    """Return the neighbours between `yes` and `no` where the answer changes, the yes first."""
    while abs(yes - no) > 1:
        middle = (yes + no) // 2
        yes, no = (middle, no) if works(middle) else (yes, middle)
    return yes, no


def check_largest(key: str, largest: float) -> None:
    """Raise a BadInputError if the schema allows no value of `key` as `largest` [any unit]."""
    path = tuple(_one_way(key).split("."))
    if exceeds(Experiment, path, largest):
        raise BadInputError(f"--max {largest:g}: {key} {expectation(Experiment, path)}")


def _one_way(key: str) -> str:
    """Return the uplink's key for a key of both directions of the link."""
    return key.replace("link.both.", "link.uplink.")


def present_value(experiment: ResolvedExperiment, key: str) -> int | float | None:
    """Return the present value of a key; None if it is null or does not exist.

    Raises:
        BadInputError: If the value is no number, or if only some numbers are allowed.
    """
    names = _one_way(key).split(".")
    value: Any = experiment.model_dump(mode="json")
    if names[:2] == ["world", "onboard"]:
        value["world"]["onboard"] = onboard_values(experiment.world)
    for name in names:
        value = child(value, name)
    if isinstance(value, list):
        raise BadInputError(f"{key}: is a list; name one of its numbers, such as {key}.0")
    if isinstance(value, str | bool | dict):
        raise BadInputError(f"{key}: is no number; name a key such as link.both.delay_ms")
    if choices := _choices(experiment, names):
        listed = ", ".join(map(str, choices))
        raise BadInputError(f"{key}: allows only {listed}; fly a sweep: 'cloudrc sweep run --help'")
    return value  # type: ignore[no-any-return]


def _choices(experiment: ResolvedExperiment, names: Iterable[str]) -> tuple[Any, ...]:
    """Return the only values that a key allows; () if it allows a range."""
    section: Any = experiment
    kind: Any = None
    for name in names:
        fields = getattr(type(section), "model_fields", {})
        kind = fields[name].annotation if name in fields else None
        section = getattr(section, name, None)
    return get_args(kind) if get_origin(kind) is Literal else ()


def limits(
    experiment: ResolvedExperiment, given: Iterable[str], seeds: int
) -> tuple[list[str], float]:
    """Return settings KEY=VALUE that raise the time limits of cloud and guard as delays need it.

    The delays are those of the seeds 1 to `seeds`. Limits that are long enough, and limits in
    `given`, stay. The second result is the time that the limits need [s]. It may be above
    `LIMIT_MAX`, and then no setting is long enough; it is infinite if no command arrives.
    """
    longest = 0.0
    for seed in range(1, seeds + 1):
        ages, echoes = simulate_ages(experiment.model_copy(update={"seed": seed}))
        if not ages:  # no command arrives
            return [], math.inf
        longest = max(longest, *ages, *echoes)
    needed = math.ceil((longest + SLACK) * 10) / 10
    time = min(needed, LIMIT_MAX)
    cloud, guard = experiment.cloud, experiment.guard
    present = {
        "cloud.horizon_max_s": (cloud.horizon_max_s, time),
        "cloud.freeze_after_s": (cloud.freeze_after_s, time),
        "guard.command_age_max_ms": (guard.command_age_max_ms, time * 1e3),
    }
    fixed = set(given)
    raised = [
        f"{key}={value:g}"
        for key, (now, value) in present.items()
        if value > now and key not in fixed
    ]
    return raised, needed
