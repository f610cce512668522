# SPDX-License-Identifier: Apache-2.0

"""Bodies of a scene that move along a closed path, as a function of time alone."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate, pairwise
from math import dist

from cloudrc.wire.messages import Vector


@dataclass(frozen=True)
class Moving:
    """A body that moves at a constant speed from point to point of its path, round and round."""

    name: str  # of the body
    path: Sequence[Vector]  # points [m], world frame; after the last one comes the first one
    speed: float  # [m/s]

    @cached_property
    def _ends(self) -> list[float]:
        """Way from the first point to each point, and round to the first one [m]."""
        ways = (dist(*pair) for pair in pairwise([*self.path, self.path[0]]))
        return [*accumulate(ways, initial=0.0)]

    def at(self, time: float) -> Vector:
        """Return its position at `time` after the mission's start [s]; before, its first point."""
        ends = self._ends
        if time <= 0.0 or not ends[-1]:
            return self.path[0]
        way = (self.speed * time) % ends[-1]
        last = bisect_right(ends, way) - 1
        start, end = self.path[last], self.path[(last + 1) % len(self.path)]
        share = (way - ends[last]) / (ends[last + 1] - ends[last])
        x, y, z = (a + share * (b - a) for a, b in zip(start, end, strict=True))
        return x, y, z
