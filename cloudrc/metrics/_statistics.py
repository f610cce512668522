"""Means that know when there is nothing to average: arrays go in, one number or None comes out."""

from __future__ import annotations

import numpy as np

from cloudrc.metrics._flight import Array


def mean(values: Array) -> float | None:
    """Average the finite ones of `values`, shape (n,), any unit; None if there are none."""
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else None


def percentile(values: Array, percent: float) -> float | None:
    """Take a percentile; None if nothing is finite.

    Args:
        values: Shape (n,), any unit; those that are not finite do not count.
        percent: Share of them that lie below [%].
    """
    finite = values[np.isfinite(values)]
    return float(np.percentile(finite, percent)) if len(finite) else None


def rms(errors: Array) -> float | None:
    """Root of the mean square of the lengths of error vectors.

    Args:
        errors: Shape (n,) or (n, 3), any unit; rows that are not finite do not count.

    Returns:
        In the unit of `errors`; None if no row counts.
    """
    squares = np.square(errors) if errors.ndim == 1 else np.square(errors).sum(axis=1)
    square = mean(squares)
    return None if square is None else float(np.sqrt(square))
