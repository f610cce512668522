"""The arm's first touch of the board, which several metrics describe."""

from __future__ import annotations

import numpy as np

from cloudrc.metrics._flight import Array, Flight

BOARD = "board"
"""Name of the scene's body that is to be touched."""


def first_touch(flight: Flight) -> dict[str, Array] | None:
    """Find the row of /contact in which the arm's tip first touched the board, if it did."""
    contact = flight.during("/contact")
    touches = np.flatnonzero((contact["body"] == BOARD) & contact["tip"].astype(bool))
    return {name: column[touches[0]] for name, column in contact.items()} if len(touches) else None
