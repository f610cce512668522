"""A cloud with valid keys that does not mean well: an honest loop, and what comes out instead."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

from cloudrc.cloud.endpoint import CloudEndpoint
from cloudrc.cloud.loop import ControlLoop
from cloudrc.messages import Command, Setpoint
from cloudrc.records import Control

Lie: TypeAlias = Callable[[Command, Control], Command]
"""What is sent in place of a command; what cloud knew when it made it stands in the record."""


def tempting(lie: Lie) -> Callable[[CloudEndpoint], None]:
    """Make what turns an honest cloud into one that lies."""

    def tempt(cloud: CloudEndpoint) -> None:
        cloud._loop = Liar(cloud._loop, lie)  # type: ignore[assignment]

    return tempt


class Liar:
    """Stands in the place of a control loop, and asks it for everything else."""

    def __init__(self, loop: ControlLoop, lie: Lie) -> None:
        self._honest, self._lie = loop, lie

    def __getattr__(self, name: str) -> Any:
        return getattr(self._honest, name)

    def command(
        self, setpoint: Setpoint, now_ns: int, dt: float, epoch: int, counter: int
    ) -> tuple[Command, Control]:
        """Compute the honest command, and send another.

        Args:
            setpoint: Where to be.
            now_ns: Cloud's clock [ns].
            dt: Time since the last command [s].
            epoch: Of the session.
            counter: That the command will carry.
        """
        command, control = self._honest.command(setpoint, now_ns, dt, epoch, counter)
        return self._lie(command, control), control
