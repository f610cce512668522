# SPDX-License-Identifier: Apache-2.0

"""The values that every door must read alike: texts and objects, each with the number it means."""

from decimal import Decimal
from fractions import Fraction
from math import inf, nan

import numpy as np

from cloudrc.base.errors import BadInputError

TEXTS = {
    **{"5": 5, "+5": 5, "5.": 5.0, ".5": 0.5, "1e3": 1000.0, " 5 ": 5, "-1": -1},
    **dict.fromkeys(("5,0", "5_0", "0x5", "", "nan", "inf", "True", "null", "5 ms", "5%", "1e999")),
    **dict.fromkeys(("\uff15", "\u0663")),  # digits of other writings
}
"""Text -> its number, None for a text that is no number. An int is a whole number."""
OBJECTS = (
    *((each, 5) for each in (5, np.int64(5), Fraction(5))),
    *((each, 5.0) for each in (5.0, np.float32(5), np.array(5.0))),
    (-0.0, 0.0),
    *((each, None) for each in (True, np.True_, np.array([5.0]), np.ma.masked, Decimal(5))),
    *((each, None) for each in ("5", b"5", None, nan, inf, 5 + 0j, np.timedelta64(5, "ms"))),
    (10**400, None),
)
"""Object and its number, None for an object that is no number. An int is a whole number."""


class Tensor:
    """A scalar of PyTorch or JAX."""

    shape = ()

    def item(self):
        return 5.0


OBJECTS = (*OBJECTS, (Tensor(), 5.0))


def expected(number, quantity):
    """Return the number that a door for a quantity reads; None if it must refuse the value."""
    if number is None or (quantity.whole and not isinstance(number, int)):
        return None
    fits = quantity.ge <= number <= quantity.le and number > quantity.gt
    return number if fits else None


def disagreements(values, quantity, read, refused):
    """Return the values that `read` reads otherwise than `quantity`, each with what it gave.

    `read` raises one of the exceptions `refused` for a value that is no number, or returns None.
    """
    found = []
    for value, number in values:
        try:
            got = read(value)
        except refused:
            got = None
        if got != expected(number, quantity):
            found.append((value, got))
    return found


def taken_otherwise(quantity, take):
    """Return the objects that `take` takes or refuses otherwise than `quantity`."""
    found = []
    for value, number in OBJECTS:
        try:
            take(value)
            is_taken = True
        except BadInputError:
            is_taken = False
        if is_taken != (expected(number, quantity) is not None):
            found.append((value, is_taken))
    return found
