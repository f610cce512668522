"""Call an executor of a user, so that its failures and wrong values name its file."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from cloudrc.gym.executors import Chunk, Executor
from cloudrc.plugins import refuse_failure, to_boolean, to_number


class WatchedExecutor(Executor):
    """An executor of a user; each failure is a BadInputError with its name."""

    def __init__(self, name: str, own: Executor, check: Callable[[Any], None]) -> None:
        """Watch `own`; `check` raises an exception for a value that is no action."""
        self._name, self._own, self._check = name, own, check

    def _call(self, method: str, *given: Any, read: Callable[[Any], Any] | None = None) -> Any:
        """Call a method; return what `read` makes of its result."""
        with refuse_failure(f"executor {self._name!r}: {method}() failed"):
            result = getattr(self._own, method)(*given)
            return read(result) if read is not None else None

    def begin(self, ticks_late: int, period_ns: int) -> None:
        """Begin an episode; a tick takes `period_ns` [ns]."""
        self._own.basis = self.basis
        self._call("begin", ticks_late, period_ns)

    def asks(self, tick: int) -> bool:
        """Return whether the robot sends the observation of this tick."""
        found: bool = self._call("asks", tick, read=partial(to_boolean, name="result"))
        return found

    def sent(self, chunk: Chunk) -> None:
        """Note that the policy has sent an answer."""
        self._call("sent", chunk)

    def prefix(self, basis: int) -> list[Any]:
        """Return the actions before the policy's answer to an observation."""
        found: list[Any] = self._call("prefix", basis, read=self._read_prefix)
        return found

    def receive(self, chunk: Chunk, tick: int) -> None:
        """Take an answer."""
        self._call("receive", chunk, tick)

    def action(self, tick: int) -> Any:
        """Return the action of this tick; None if there is none."""
        return self._call("action", tick, read=partial(self._read_action, tick))

    def _read_prefix(self, actions: Any) -> list[Any]:
        found = [] if actions is None else [*actions]
        for action in found:
            self._check(action)
        return found

    def _read_action(self, tick: int, action: Any) -> Any:
        if action is None:
            return None
        self._check(action)
        basis = to_number(self._own.basis, "basis")
        if not 0 <= basis <= tick:
            raise ValueError(f"its basis is {basis:g}, not the tick of an observation, 0 to {tick}")
        self.basis = basis
        return action
