# SPDX-License-Identifier: Apache-2.0

"""Computing time on cores that the clouds of several robots share."""

from __future__ import annotations

from collections.abc import Callable

from cloudrc.cloud.compute_time import ComputeTime

FOREVER_NS = 1 << 62
"""Computing time of which the end is not known yet [ns]."""


class SharedCompute(ComputeTime):
    """Time to compute a command on shared cores: who shares them finds out when it ends.

    Attributes:
        shortest_ns: Duration of the next computation on a core of its own [ns].
    """

    def __init__(self, own: ComputeTime, begins: Callable[[int], None]) -> None:
        """Draw the durations from `own`, in the same order as without sharing.

        `begins` gets the duration of a computation that begins, on a core of its own [ns].
        """
        self._own, self._begins, self.shortest_ns = own, begins, own.end(0)

    def begin(self) -> None:
        """Nothing is measured."""

    def end(self, began_ns: int) -> int:
        """Ask for a core; return `FOREVER_NS`. `began_ns` is not used."""
        self._begins(self.shortest_ns)
        self.shortest_ns = self._own.end(0)
        return FOREVER_NS
