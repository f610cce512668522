# SPDX-License-Identifier: Apache-2.0

"""Angles and distances of the rays of a scan, and its record."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from math import inf, radians
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cloudrc.wire.messages import RangeScan
from cloudrc.wire.records import ScanTaken

if TYPE_CHECKING:
    from cloudrc.config.robot import ScanConfig

RAY_MAX_MM = 2**16 - 1
"""Largest distance in a datagram [mm]."""


def angles_of(rays: int, fov_deg: float) -> NDArray[np.float64]:
    """Return the angles of `rays` rays over `fov_deg` [deg], with a ray at each of its ends [rad].

    0 is ahead; they rise to the left.
    """
    half = radians(fov_deg) / 2.0
    return np.linspace(-half, half, rays)


def ranges_of(millimetres: Sequence[int]) -> NDArray[np.float64]:
    """Return the distances of a scan's rays [m]; inf where nothing was within range, 0 mm."""
    found = np.array(millimetres, float)
    return np.where(found > 0.0, found * 1e-3, inf)


def scan_record(config: ScanConfig, epoch: int, counter: int, scan: RangeScan) -> ScanTaken:
    """Return the record of a scan and of its datagram, in the precision of ROS's message.

    `config` is the key `scan` of robot.yaml.
    """
    first, step, period, reach = _shape(config.rays, config.fov_deg, config.rate_hz, config.range_m)
    ranges = [*map(_METRES.__getitem__, scan.millimetres)]
    return ScanTaken(scan.stamp_ns, epoch, counter, first, step, period, reach, ranges)


@cache
def _shape(rays: int, fov_deg: float, rate_hz: int, range_m: float) -> tuple[float, ...]:
    """Return first angle [rad], angle between two rays [rad], period [s] and range [m]."""
    first, second = angles_of(rays, fov_deg)[:2]
    values = np.array([first, second - first, 1.0 / rate_hz, range_m])
    return tuple(values.astype(np.float32).tolist())


_METRES: list[float] = ranges_of(range(RAY_MAX_MM + 1)).astype(np.float32).tolist()
"""Distance in a datagram [mm] -> distance in ROS's message [m]."""
