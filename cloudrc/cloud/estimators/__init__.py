"""Delay estimators: what arrives says how long the loop is; one file each, found by its name.

A plug-in file has a `build(**parameters)` with annotated parameters that returns an `Estimator`.
"""

from __future__ import annotations

from typing import NamedTuple


class DelaySample(NamedTuple):
    """What one newly echoed command tells about the delays.

    Attributes:
        loop_delay: Arrival of the echo minus the command's stamp [s]; hold on world included.
        rtt: The same without the hold [s].
        applied_minus_stamp: Instant of application on world's clock minus the command's stamp on
            cloud's [s]: the downlink delay plus the unknown offset world - cloud.
    """

    loop_delay: float
    rtt: float
    applied_minus_stamp: float


class Estimator:
    """Estimates the horizon: from the measurement to the application of the command."""

    def update(self, sample: DelaySample) -> None:
        """Take in one sample; called once per newly echoed command, never for a repeated echo."""
        raise NotImplementedError

    def horizon(self, age: float) -> float:
        """Say how far to look ahead from the newest odometry, for a command that leaves now.

        Args:
            age: Now on cloud's clock minus the odometry's stamp on world's [s]: its uplink delay,
                how long cloud has held it, and the unknown offset cloud - world.

        Returns:
            Horizon [s]; 0 before the first sample.
        """
        raise NotImplementedError
