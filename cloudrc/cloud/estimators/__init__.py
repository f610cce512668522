# SPDX-License-Identifier: Apache-2.0

"""Delay estimators compute the horizon: how far ahead the predictor predicts.

Telemetry echoes the stamp of the newest command that world has applied; estimators get the delays
that these echoes show. Each estimator is a plug-in in a file of its own. The file defines
`build(**parameters)`, which returns an `Estimator`; all parameters are annotated.
"""

from __future__ import annotations

from typing import NamedTuple


class DelaySample(NamedTuple):
    """The delays that the echo in one telemetry datagram shows; a long hold time gives no sample.

    Attributes:
        loop_delay: Arrival of the echo minus the command's stamp [s]. The loop delay includes the
            hold time: the time between the application of the command and the sending of the echo.
        rtt: `loop_delay` minus the hold time [s].
    """

    loop_delay: float
    rtt: float


class Estimator:
    """Estimates the horizon: the time from measuring the odometry to applying the command."""

    def update(self, sample: DelaySample) -> None:
        """Add the delays that one telemetry datagram shows.

        Several datagrams may echo the same command; each of them gives a sample.
        """

    def add_applied(self, applied_minus_stamp: float) -> None:
        """Add a command that world has applied; called once per command, when its echo arrives.

        Args:
            applied_minus_stamp: Time of application on world's clock minus the command's stamp on
                cloud's clock [s]: the downlink delay minus the unknown clock offset (cloud's clock
                minus world's).
        """

    def horizon(self, age: float) -> float:
        """Return the horizon [s] for a command that leaves now; 0 before the first sample.

        Args:
            age: Now on cloud's clock minus the newest odometry's stamp on world's clock [s]: the
                sum of uplink delay, time in cloud, and the unknown clock offset (cloud's clock
                minus world's).
        """
        raise NotImplementedError
