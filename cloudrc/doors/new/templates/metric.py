# SPDX-License-Identifier: Apache-2.0

"""Length of the robot's way.

Source: sum of the distances between successive true positions.
"""

import numpy as np

from cloudrc.plugin import Flight

UNIT = "m"


def measure(flight: Flight) -> float | None:
    """Return the number [m]; None means that this flight has none."""
    positions = flight.truth["position"]  # [m], world frame, shape (n, 3)
    if len(positions) < 2:
        return None
    return float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())
