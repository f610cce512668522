"""Simulate the time that cloud computes before a command leaves."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np


class ComputeTime:
    """Simulated time to compute a command: constant, random or measured.

    A random time has a gamma distribution, which is never negative and sometimes long.
    """

    def __init__(
        self,
        mean_ns: float,
        deviation_ns: float,
        rng: np.random.Generator,
        cpu_clock: Callable[[], int] | None = None,
    ) -> None:
        """Set the mean `mean_ns` [ns] and the standard deviation `deviation_ns` [ns].

        If `cpu_clock` is given, its time [ns] between `begin` and `end` is added.
        """
        self._mean_ns, self._deviation_ns, self._rng = mean_ns, deviation_ns, rng
        self._cpu_clock, self._began_ns = cpu_clock, 0

    def begin(self) -> None:
        """Note that the computation of a command begins."""
        if self._cpu_clock is not None:
            self._began_ns = self._cpu_clock()

    def end(self) -> int:
        """Return the time that the computation since `begin` takes in the simulation [ns]."""
        time_ns = self._mean_ns
        if self._deviation_ns:
            shape = (self._mean_ns / self._deviation_ns) ** 2
            time_ns = self._rng.gamma(shape, self._mean_ns / shape)
        if self._cpu_clock is not None:
            time_ns += self._cpu_clock() - self._began_ns
        return round(time_ns)
