"""Control periods to feed: everything that a test does not name is still."""

from __future__ import annotations

from math import nan
from typing import Any

from cloudrc.messages import UPRIGHT, ZERO
from cloudrc.records import Control

MS = 1_000_000


def period(stamp_ms: float, basis_ms: float, **fields: Any) -> Control:
    """One period at `stamp_ms` of cloud's clock, from odometry of `basis_ms` of world's."""
    still = Control(
        round(stamp_ms * MS),
        1,
        0,
        round(basis_ms * MS),
        0.0,
        nan,
        nan,
        ZERO,
        ZERO,
        UPRIGHT,
        ZERO,
        ZERO,
        0,
        ZERO,
        0.0,
        ZERO,
        ZERO,
        ZERO,
    )
    return still._replace(**fields)
