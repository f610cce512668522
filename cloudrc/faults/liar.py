"""A cloud with valid keys that does not mean well: an honest loop, and what comes out instead."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

from cloudrc.cloud.endpoint import CloudEndpoint
from cloudrc.cloud.loop import ControlLoop
from cloudrc.messages import Command, GuardState, OperatorRequest, Setpoint
from cloudrc.records import Control

Lie: TypeAlias = Callable[[Command, Control], Command]
"""What is sent in place of a command; what cloud knew when it made it stands in the record."""

Words: TypeAlias = Callable[[Control, GuardState], OperatorRequest | None]
"""What is said with it in the operator's name, if anything, to a robot whose guard was last seen
in that state; cloud gives it its number."""


def drop(request: OperatorRequest) -> None:
    """What the operator says is not passed on."""


def tempting(lie: Lie, words: Words | None = None) -> Callable[[CloudEndpoint], None]:
    """Make what turns an honest cloud into one that lies, and speaks in its operator's place."""

    def tempt(cloud: CloudEndpoint) -> None:
        relay = cloud._relay

        def speak(control: Control) -> None:
            if words is None:
                return
            cloud._relay = drop  # type: ignore[method-assign]
            if (said := words(control, cloud.guard)) is not None:
                relay(said._replace(number=cloud._asked + 1))

        cloud._loop = Liar(cloud._loop, lie, speak)  # type: ignore[assignment]

    return tempt


class Liar:
    """Stands in the place of a control loop, and asks it for everything else."""

    def __init__(self, loop: ControlLoop, lie: Lie, speak: Callable[[Control], None]) -> None:
        self._honest, self._lie, self._speak = loop, lie, speak

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
        self._speak(control)
        return self._lie(command, control), control
