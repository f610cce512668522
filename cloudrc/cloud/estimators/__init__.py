"""Delay estimators compute the horizon of the prediction from echoes; one file each.

A plug-in file has a `build(**parameters)` with annotated parameters that returns an `Estimator`.
"""

from __future__ import annotations

from typing import NamedTuple


class DelaySample(NamedTuple):
    """The delays that one newly echoed command shows.

    Attributes:
        loop_delay: Arrival of the echo minus the command's stamp [s]; includes the hold on world.
        rtt: The same without the hold [s].
        applied_minus_stamp: Instant of application on world's clock minus the command's stamp on
            cloud's clock [s]: the downlink delay plus the unknown offset world - cloud.
    """

    loop_delay: float
    rtt: float
    applied_minus_stamp: float


class Estimator:
    """Estimate the horizon: the time from the measurement to the application of the command."""

    def update(self, sample: DelaySample) -> None:
        """Add one sample; called once per newly echoed command, never for a repeated echo."""
        raise NotImplementedError

    def horizon(self, age: float) -> float:
        """Return how far to predict from the newest odometry for a command that leaves now.

        Args:
            age: Now on cloud's clock minus the odometry's stamp on world's clock [s]: its uplink
                delay, its time in cloud, and the unknown offset cloud - world.

        Returns:
            Horizon [s]; 0 before the first sample.
        """
        raise NotImplementedError
