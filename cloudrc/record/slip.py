"""World's clock lags its machine's after a stall: instants on that one in, on world's out."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cloudrc.record.columns import Table


class WorldTime:
    """Knows by how much world's clock lagged at every instant of a recording."""

    def __init__(self, telemetry: Table) -> None:
        """Learn it from what telemetry says.

        Args:
            telemetry: Of world; its stamps are on world's clock.
        """
        self._slip_ns = telemetry["slip_ns"]
        self._machine_ns = telemetry["stamp_ns"] + self._slip_ns

    def at(self, machine_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Convert instants; between two samples world's clock is taken to run evenly.

        Args:
            machine_ns: On the machine's clock [ns], shape (n,).

        Returns:
            On world's clock [ns], shape (n,); rising if the argument rises.
        """
        if not self._slip_ns.any():
            return machine_ns
        # Differences are exact in float64; the stamps themselves need not be.
        first: Any = self._machine_ns[0]
        since, known = (machine_ns - first).astype(float), (self._machine_ns - first).astype(float)
        slip_ns: NDArray[np.int64] = np.rint(np.interp(since, known, self._slip_ns)).astype(int)
        return machine_ns - slip_ns
