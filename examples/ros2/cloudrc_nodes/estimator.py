# SPDX-License-Identifier: Apache-2.0

"""The paper's estimator as a node: the mean of all loop delays so far, eq. (1).

A delay is a TimeReference: `header.stamp` minus `time_ref`.
"""

from __future__ import annotations

from typing import Any

from builtin_interfaces.msg import Time
from rclpy.node import Node
from sensor_msgs.msg import TimeReference

from cloudrc_nodes.pairs import NEWEST, nanoseconds, run


class Estimator(Node):
    """Publishes, for each loop delay, how far ahead to predict."""

    def __init__(self, **options: Any) -> None:
        super().__init__("estimator", **options)
        self._horizons = self.create_publisher(TimeReference, "horizon", NEWEST)
        self.create_subscription(TimeReference, "cloudrc/loop_delay", self._add, NEWEST)
        self._stamp_ns, self._count, self._mean_ns = 0, 0, 0.0

    def _add(self, delay: TimeReference) -> None:
        stamp_ns = nanoseconds(delay.header.stamp)
        if stamp_ns < self._stamp_ns:  # another flight
            self._count, self._mean_ns = 0, 0.0
        self._stamp_ns = stamp_ns
        if delay_ns := stamp_ns - nanoseconds(delay.time_ref):
            self._count += 1
            self._mean_ns += (delay_ns - self._mean_ns) / self._count
        sec, nanosec = divmod(stamp_ns - round(self._mean_ns), 1_000_000_000)
        horizon = TimeReference(header=delay.header, time_ref=Time(sec=sec, nanosec=nanosec))
        self._horizons.publish(horizon)


def main() -> None:
    """Run the node."""
    run(Estimator)


if __name__ == "__main__":
    main()
