# SPDX-License-Identifier: Apache-2.0

"""Find the values of a key at which a question is answered with yes, such as "is the loop stable?".

All values are multiples of a resolution, so that the search is over whole numbers. A coarse grid
comes first, because the answer may change more than once. Then each end of the range around the
present value is bisected.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import groupby
from typing import NamedTuple

Works = Callable[[int], bool]


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
    every = (int(present * 2.0**power) for power in range(-60, 61))
    return sorted({min(max(number, bottom), top) for number in every})


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
    every = groupby(range(len(answers)), answers.__getitem__)
    runs = [[*indices] for answer, indices in every if answer]
    return [(run[0], run[-1]) for run in runs]


def bisect(works: Works, yes: int, no: int) -> tuple[int, int]:
    """Return the neighbours between `yes` and `no` where the answer changes, the yes first."""
    while abs(yes - no) > 1:
        middle = (yes + no) // 2
        yes, no = (middle, no) if works(middle) else (yes, middle)
    return yes, no
