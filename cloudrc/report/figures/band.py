"""What the link was asked to be, over time: a direction's conditions become a band of delays."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cloudrc.config.schema import Direction
from cloudrc.errors import BadInputError
from cloudrc.link.traces import read_trace
from cloudrc.metrics.flight import Array


@dataclass(frozen=True, slots=True)
class Band:
    """Delay asked for, in steps; n rows.

    Attributes:
        time: When each step begins, since the link came up [s], shape (n,).
        low: Delay minus jitter, not below 0 [s], shape (n,).
        high: Delay plus jitter [s], shape (n,).
    """

    time: Array
    low: Array
    high: Array


def band(direction: Direction) -> Band | None:
    """Work out the delays that a direction was asked to have.

    For uniform jitter these are the bounds, for the others one standard deviation each way.

    Returns:
        None if the delays come from a trace that is no longer there.
    """
    try:
        steps = _traced(Path(direction.trace)) if direction.trace else [(0.0, direction.delay_ms)]
    except BadInputError:
        return None
    delay, jitter = steps[0][1], direction.jitter_ms
    changes = {} if direction.trace else {c.at_s: c.delay_ms for c in direction.changes}
    delays = {**dict(steps), **{at: ms for at, ms in changes.items() if ms is not None}}
    jitters = {c.at_s: c.jitter_ms for c in direction.changes if c.jitter_ms is not None}
    rows = []
    for at in sorted({*delays, *jitters}):
        delay, jitter = delays.get(at, delay), jitters.get(at, jitter)
        rows.append((at, max(delay - jitter, 0.0) * 1e-3, (delay + jitter) * 1e-3))
    time, low, high = np.array(rows).T
    return Band(time, low, high)


def at(steps: Band, time: Array) -> tuple[Array, Array]:
    """Look up the lower and upper bound [s] at each `time` [s] since the link came up."""
    rows = np.maximum(np.searchsorted(steps.time, time, side="right") - 1, 0)
    return steps.low[rows], steps.high[rows]


def _traced(path: Path) -> list[tuple[float, float]]:
    """Read instants [s] and delays [ms] of a trace; the first row also holds before its time."""
    trace = read_trace(path)
    delays = [delay * 1e3 for delay in trace.delays]
    return [(0.0, delays[0]), *zip(trace.times, delays, strict=True)]
