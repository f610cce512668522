"""Computing time on cores that the clouds of several robots share."""

from __future__ import annotations

from collections.abc import Callable

from cloudrc.cloud.endpoint import ComputeTime

FOREVER_NS = 1 << 62
"""Computing time of which the end is not known yet [ns]."""


class SharedCompute(ComputeTime):
    """Time to compute a command on shared cores: who shares them finds out when it ends.

    Attributes:
        shortest_ns: Duration of the next computation on a core of its own [ns].
        begun: Begin and duration of a computation that nobody has taken yet [ns]; None without one.
        now_ns: Returns the virtual time [ns].
        finish: Lets the computation end at a virtual time [ns].
    """

    now_ns: Callable[[], int]
    finish: Callable[[int], None]

    def __init__(self, own: ComputeTime) -> None:
        """Draw the durations from `own`, in the same order as without sharing."""
        self._own, self.shortest_ns = own, own.end()
        self.begun: tuple[int, int] | None = None

    def begin(self) -> None:
        """Nothing is measured."""

    def end(self) -> int:
        """Note that a computation has begun; return `FOREVER_NS`."""
        self.begun = self.now_ns(), self.shortest_ns
        self.shortest_ns = self._own.end()
        return FOREVER_NS
