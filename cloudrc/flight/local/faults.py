# SPDX-License-Identifier: Apache-2.0

"""Inject faults of processes in real time, by signals."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from signal import SIGCONT, SIGKILL, Signals
from typing import TYPE_CHECKING

from cloudrc.config.faults import (
    TELEOP_KILLED,
    FaultConfig,
    acting,
)
from cloudrc.flight.virtual.faults import SIGNALS

if TYPE_CHECKING:
    from cloudrc.flight.local.children import Child


class SignalledFaults:
    """Sends the signals of faults to the processes of a local run, and starts killed ones again.

    Attributes:
        away: Processes that are killed or stand still.
        kills_teleop: Whether teleop has to store its mission.
    """

    def __init__(self, faults: Sequence[FaultConfig]) -> None:
        """Send nothing before `begin`."""
        self.away = set[str]()
        self.kills_teleop = bool(acting(faults, TELEOP_KILLED))
        self._planned = list[tuple[float, str, Signals]]()
        for fault in acting(faults, *SIGNALS):
            name, number = SIGNALS[fault.kind]
            self._planned += [(fault.at_s, name, number), (fault.end, name, SIGCONT)]
        self._planned.sort()

    def begin(self, up: float, again: Mapping[str, Callable[[], None]]) -> None:
        """Count from `up` [s], monotonic clock, when the link came up.

        `again` starts the process of a name.
        """
        self._origin, self._again = up, again

    def act(self, now: float, children: list[Child]) -> None:
        """Do what is due at `now` [s], monotonic clock, with the running `children`."""
        while self._planned and self._planned[0][0] <= now - self._origin:
            _, name, number = self._planned.pop(0)
            running = [each for each in children if each.name == name]
            self.away ^= {name}
            for child in running:
                child.process.send_signal(number)
                if number == SIGKILL:
                    child.process.wait()
                    children.remove(child)
            if not running:
                self._again[name]()
