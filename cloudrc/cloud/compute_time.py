# SPDX-License-Identifier: Apache-2.0

"""The time that cloud needs to compute, in virtual time or on top of the true one."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from cloudrc.config.cloud import Cloud
from cloudrc.config.compute import compute_times

MS_TO_NS = 1_000_000

QUOTA_PERIOD_NS = 100_000_000
"""Time between two refills of a CPU limit [ns].
Source: Linux, Documentation/scheduler/sched-bwc.rst; Kubernetes, default of cpuCFSQuotaPeriod."""


class ComputeTime:
    """Simulated time to compute a command: constant, random or measured.

    A random time has a gamma distribution, which is never negative and sometimes long.

    With a CPU limit, cloud computes for a share of each QUOTA_PERIOD_NS, and then stands still
    until the next of these periods. So a CPU limit is no slow processor: most short computations
    are as fast as without it, some wait long.
    Source: Linux, Documentation/scheduler/sched-bwc.rst.
    Deviation: the periods follow each other without a gap, also while cloud is idle.
    """

    def __init__(
        self,
        mean_ns: float,
        deviation_ns: float,
        rng: np.random.Generator,
        cpu_clock: Callable[[], int] | None = None,
        cpu_share: float = 1.0,
        times_ns: Sequence[float] = (),
    ) -> None:
        """Set mean `mean_ns` and standard deviation `deviation_ns` of the compute time [ns].

        `cpu_clock` returns the CPU time used so far [ns]. If it is given, the CPU time between
        `begin` and `end` is added. `cpu_share` is the CPU limit, in processors [1]. Of `times_ns`,
        if there are any, each computation takes a random one [ns].
        """
        self._times_ns = times_ns
        self._mean_ns, self._deviation_ns, self._rng = mean_ns, deviation_ns, rng
        self._cpu_clock, self._began_ns = cpu_clock, 0
        self._quota_ns = round(cpu_share * QUOTA_PERIOD_NS)
        self._used_ns, self._period = 0, 0  # time used in the period with this number

    def begin(self) -> None:
        """Note that the computation of a command begins; call `end` at its end."""
        if self._cpu_clock is not None:
            self._began_ns = self._cpu_clock()

    def end(self, began_ns: int) -> int:
        """Return the simulated duration [ns] of the computation that started with `begin`.

        It began at `began_ns` [ns], cloud's clock.
        """
        time_ns = self._mean_ns
        if self._times_ns:
            time_ns = self._times_ns[int(self._rng.integers(len(self._times_ns)))]
        elif self._deviation_ns:
            shape = (self._mean_ns / self._deviation_ns) ** 2
            time_ns = self._rng.gamma(shape, self._mean_ns / shape)
        if self._cpu_clock is not None:
            time_ns += self._cpu_clock() - self._began_ns
        return self._limit(round(time_ns), began_ns)

    def _limit(self, left_ns: int, began_ns: int) -> int:
        """Return how long a computation lasts under the CPU limit [ns].

        `left_ns` is the processor time that it needs, `began_ns` when it began, both [ns].
        """
        now_ns = began_ns
        while left_ns and self._quota_ns < QUOTA_PERIOD_NS:
            period = now_ns // QUOTA_PERIOD_NS
            if period != self._period:
                self._used_ns, self._period = 0, period
            end_ns = (period + 1) * QUOTA_PERIOD_NS
            run_ns = min(left_ns, self._quota_ns - self._used_ns, end_ns - now_ns)
            left_ns, self._used_ns = left_ns - run_ns, self._used_ns + run_ns
            now_ns = end_ns if left_ns else now_ns + run_ns
        return now_ns - began_ns + left_ns


def compute_time(
    cloud: Cloud,
    given_ms: float | str,
    draws: np.random.Generator,
    cpu_clock: Callable[[], int] | None,
    *,
    deviation_ms: float = 0.0,
    cpu_share: float = 1.0,
) -> ComputeTime | None:
    """Make the time of a key such as `compute_ms` on the processor of `cloud`; None: no time.

    `given_ms` is the key's value, a time [ms] or a file; `deviation_ms` is in [ms], `cpu_share` in
    processors [1]. The others are those of `ComputeTime`.
    """
    if not (given_ms or cpu_clock):
        return None
    scale = MS_TO_NS / cloud.speed
    times = [each * scale for each in compute_times(given_ms)]
    drawn = times if len(times) > 1 else ()
    return ComputeTime(times[0], deviation_ms * scale, draws, cpu_clock, cpu_share, drawn)
