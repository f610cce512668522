# SPDX-License-Identifier: Apache-2.0

"""Telemetry of a robot that stands still, as world records it."""

from cloudrc.wire.messages import UPRIGHT, ZERO, GuardState, Odometry, Telemetry
from cloudrc.wire.records import TelemetrySent


def told(stamp_ns, guard=GuardState.TRACK, **fields):
    odometry = Odometry(stamp_ns, (1.0, 2.0, 3.0), UPRIGHT, ZERO, ZERO)
    telemetry = Telemetry(stamp_ns, odometry, (), -1, 0, 0, 0, guard, touch_speed=0.0, **fields)
    return TelemetrySent(stamp_ns, 1, 1, telemetry)
