# SPDX-License-Identifier: Apache-2.0

"""Controller: a program outside of cloudrc, which answers over a WebSocket.

It gets the predicted odometry and the setpoint, and answers with the velocities of this period and
of the following ones.

Source: docs/remote.md, "The messages".
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from math import nan
from typing import Any, Protocol

from cloudrc.cloud.controllers import STAND_STILL, Controller, ControlOutput
from cloudrc.config.schema import Positive, ServerUrl
from cloudrc.wire.messages import Odometry, Setpoint

Answer = tuple[float, Sequence[Sequence[float]]]
"""Age of the answered observation [s], and the rows vx, vy, vz [m/s], world frame, yaw rate [rad/s]
for its period and the following ones; without rows cloud sends nothing."""
Surroundings = Callable[[], tuple[int, Odometry | None, float, float]]
"""Function that returns cloud's time [ns], the newest odometry as it has arrived, the newest loop
delay [s], NaN before the first, and the horizon [s]."""
ROUNDING = 1e-6
"""Part of a period by which an answer may be younger than a whole period, and count as one [1]."""


class ControllerTransport(Protocol):
    """The way to the program: in lock step in virtual time, through a process in real time."""

    def begin(self) -> None:
        """Begin an episode: the next observation is the first of a session or mission."""

    def exchange(self, observation: dict[str, Any]) -> Answer | None:
        """Send an observation; return the newest answer that may still be flown, or None.

        Raises:
            ControllerLostError: If the program is silent for too long, or its answer is wrong.
        """


class OutsideController(Controller):
    """Asks a program for each command; stands still while it has no valid answer.

    Attributes:
        transport: Name or path of the transport to the program: see `flight.pod.transports`.
        place: Where the program is: an address, or a namespace of ROS.
        start_limit: Time limit for the first answer of an episode [s].
        surroundings: What there is to know besides estimate and setpoint.
    """

    transport = "remote"

    def __init__(self, place: str, start_limit: float) -> None:
        self.place, self.start_limit = place, start_limit
        self.surroundings: Surroundings = lambda: (0, None, nan, 0.0)  # nothing is known
        self._transport: ControllerTransport | None = None
        self._period = 0.0
        self._counts: Counter[str] = Counter()
        self._flies = False

    def connect(
        self,
        transport: ControllerTransport,
        period: float,
        counts: Counter[str],
        surroundings: Surroundings | None = None,
    ) -> None:
        """Use `transport` for the flight.

        `period` is the time between two commands [s]. Gaps between answers are counted in `counts`.
        """
        self.surroundings = surroundings or self.surroundings
        self._transport, self._period, self._counts = transport, period, counts
        counts["controller_gaps"] += 0  # so that a recording tells that there was none

    def reset(self) -> None:
        """Begin an episode at the start of a session or mission."""
        self._flies = False
        if self._transport is not None:
            self._transport.begin()

    def update(self, estimate: Odometry, setpoint: Setpoint, dt: float) -> ControlOutput | None:
        """Return the command of the newest answer for this period; `dt` is the period [s].

        Raises:
            ControllerLostError: If the program is lost: the flight has to end.
        """
        if self._transport is None:
            return STAND_STILL
        answer = self._transport.exchange(self.observe(estimate, setpoint, dt))
        if answer is None:
            self._counts["controller_gaps"] += self._flies
            self._flies = False
            return STAND_STILL
        self._flies = True
        age, rows = answer
        if not rows:
            return None
        x, y, z, yaw_rate = rows[min(int(age / self._period + ROUNDING), len(rows) - 1)]
        return ControlOutput((x, y, z), yaw_rate)

    def observe(self, estimate: Odometry, setpoint: Setpoint, dt: float) -> dict[str, Any]:
        """Return what the program gets to know; `dt` is the period [s]."""
        return {
            "stamp_ns": estimate.stamp_ns,
            "position": estimate.position,
            "orientation_wxyz": estimate.orientation_wxyz,
            "velocity": estimate.velocity,
            "angular_velocity": estimate.angular_velocity_body,
            "setpoint/position": setpoint.position,
            "setpoint/velocity": setpoint.velocity,
            "setpoint/yaw": setpoint.yaw,
            "period_s": dt,
        }


def build(
    url: ServerUrl = "ws://127.0.0.1:8000", start_limit_s: Positive = 60.0
) -> OutsideController:
    """Make the controller.

    Args:
        url: Address of the program, such as ws://127.0.0.1:8000.
        start_limit_s: Time limit for the first answer of an episode [s].
    """
    return OutsideController(url, start_limit_s)
