# SPDX-License-Identifier: Apache-2.0

"""Random numbers of a flight: an independent generator for each use."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    pass

SECOND_NS = 1_000_000_000


def generator(seed: int, *names: str) -> np.random.Generator:
    """Make a random number generator; generators with different `names` are independent."""
    stream = " ".join(filter(None, names))
    return np.random.Generator(np.random.PCG64([seed, int.from_bytes(stream.encode(), "little")]))
