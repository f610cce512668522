"""Round trips as cloud measured them, one per echo."""

from __future__ import annotations

import numpy as np

from cloudrc.metrics._flight import Array, Flight


def round_trips(flight: Flight) -> dict[str, Array]:
    """Take the control periods in which a new echo had come in.

    A period without one repeats the values of the period before; to count it would give a silent
    downlink, whose last echo is repeated for seconds, the greatest weight.
    """
    control = flight.control
    pair = np.stack([control["rtt"], control["loop_delay"]], axis=1)
    new = np.ones(len(pair), dtype=bool)
    new[1:] = (pair[1:] != pair[:-1]).any(axis=1)
    return {name: column[new] for name, column in control.items()}
