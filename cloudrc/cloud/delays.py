"""What telemetry tells about the delays: echoes become samples, samples become a horizon.

All ages are measured on cloud's own clock; world's stamps are only ever compared with each other,
so no clock synchronisation is needed.
"""

from __future__ import annotations

from collections import Counter
from math import isfinite, nan

from cloudrc.cloud.estimators import DelaySample, Estimator
from cloudrc.messages import NEVER_NS, Telemetry

HORIZON_MAX = 1.0
"""Longest horizon of a prediction [s]. Source: docs/reference/control.md, "Predictors"."""


class DelayMeter:
    """Feeds a delay estimator and asks it how far to look ahead.

    Attributes:
        rtt: Last round trip, hold excluded [s]; NaN before the first.
        loop_delay: Last `now - echo_stamp`, hold included [s]; NaN likewise.
        newest_echo_ns: Stamp of the newest command that is seen to be flown [ns], cloud's clock.
    """

    def __init__(self, estimator: Estimator, counts: Counter[str]) -> None:
        """Ask `estimator`; what is clamped is counted in `counts`."""
        self._estimator, self._counts = estimator, counts
        self.newest_echo_ns = NEVER_NS
        self._stamp_ns = 0
        self.rtt = nan
        self.loop_delay = nan

    def observe(self, telemetry: Telemetry, now_ns: int) -> None:
        """Take in telemetry that became the newest, at its arrival.

        A repeated echo is no sample: while the downlink is silent the same command is echoed over
        and over, and its growing age would poison the estimate.
        """
        self._stamp_ns = telemetry.stamp_ns
        if telemetry.echo_stamp_ns <= self.newest_echo_ns:
            return
        self.newest_echo_ns = telemetry.echo_stamp_ns
        loop_ns = now_ns - telemetry.echo_stamp_ns
        applied_ns = telemetry.stamp_ns - telemetry.echo_hold_ns
        self.loop_delay = loop_ns * 1e-9
        self.rtt = (loop_ns - telemetry.echo_hold_ns) * 1e-9
        applied_minus_stamp = (applied_ns - telemetry.echo_stamp_ns) * 1e-9
        self._estimator.update(DelaySample(self.loop_delay, self.rtt, applied_minus_stamp))

    def horizon(self, now_ns: int) -> float:
        """How far to look ahead from the newest odometry for a command that leaves now.

        Args:
            now_ns: Cloud's clock [ns].

        Returns:
            Horizon [s], in [0, 1].

        Raises:
            ValueError: If the estimator gives something that is not finite.
        """
        horizon = float(self._estimator.horizon((now_ns - self._stamp_ns) * 1e-9))
        if 0.0 <= horizon <= HORIZON_MAX:
            return horizon
        if not isfinite(horizon):
            raise ValueError(f"its horizon is {horizon}")
        self._counts["horizon_clamped"] += 1
        return min(max(horizon, 0.0), HORIZON_MAX)
