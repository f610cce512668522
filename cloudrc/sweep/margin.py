"""Search the largest value of a key with which every flight succeeds."""

from __future__ import annotations

from collections.abc import Callable


def largest_stable(works: Callable[[int], bool], start: int, top: int) -> tuple[int, int | None]:
    """Find the largest step k from 1 to `top` for which `works(k)`; assume that all below work.

    Double from `start` until a step fails, then bisect.

    Returns:
        The largest step that works, 0 if none does; and the next step, which fails, or None if
        even `top` works.
    """
    low, high, step = 0, start, start
    while works(step):
        low = step
        if step == top:
            return top, None
        step = high = min(2 * step, top)
    while high - low > 1:
        middle = (low + high) // 2
        if works(middle):
            low = middle
        else:
            high = middle
    return low, high
