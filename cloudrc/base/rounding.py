# SPDX-License-Identifier: Apache-2.0

"""What is equal up to rounding is equal: one rule for every comparison of computed numbers.

The rule holds wherever a number of a flight is compared with a limit of a user or of the verdict,
or with a number of another flight. Loop, link, guard and physics compare exactly.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

ROUNDING = 1e-9
"""Two numbers are equal if they differ by less than this share of the larger one [1]."""
NOISE = 1e-12
"""Two numbers are equal if they differ by less than this [any SI unit]: a number that is 0 but for
rounding has no size of its own."""


def differences(a: ArrayLike, b: ArrayLike) -> NDArray[Any]:
    """Return b - a, any unit and shape; 0 where a and b are equal up to rounding."""
    a, b = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    found = b - a
    tied = np.abs(found) < np.maximum(NOISE, ROUNDING * np.maximum(np.abs(a), np.abs(b)))
    return np.where(tied, 0.0, found)


def exceeds(value: float, limit: float) -> bool:
    """Return whether `value` is above `limit`, both in any unit, by more than rounding."""
    # Without a call of a function: teleop asks for each telemetry.
    above = value - limit
    if not above > 0.0:
        return False
    least = ROUNDING * (value if value > -limit else -limit)
    return above >= least if least > NOISE else above >= NOISE
