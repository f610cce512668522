# SPDX-License-Identifier: Apache-2.0

"""Load a policy from a file of the user."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from cloudrc.base.errors import CloudrcError
from cloudrc.base.outside.code import FAILURES, calling, check_failure, locate, stack_of
from cloudrc.base.outside.values import InvalidValueError
from cloudrc.base.plugins import find


class PolicyFailedError(CloudrcError):
    """A policy raised an exception, or its answer is no chunk of actions.

    Attributes:
        stack: The failure's stack as Python prints it; "" if nothing was raised.
    """

    exit_code = 5

    def __init__(self, text: str, stack: str = "") -> None:
        super().__init__(text)
        self.stack = stack


class LoadedPolicy:
    """A policy of the user in this process: the functions `infer` and, if there is one, `reset`."""

    def __init__(self, name: str) -> None:
        """Load the file `name`, which has `infer` itself or a `build()` that returns a policy."""
        self.name = name
        policy = find("policies", name, look=False)
        build, infer = policy.get("build"), policy.get("infer")
        what = f"policy '{name}' cannot be built"
        with calling(what, slow=f"{name} is still being built"):
            is_built = build is not None and infer is None
            read = partial(_attribute, build()) if is_built else policy.get
            infer, reset, metadata = read("infer"), read("reset"), read("metadata")
            self.metadata: dict[str, Any] = dict(metadata) if isinstance(metadata, Mapping) else {}
            if not callable(infer):
                raise InvalidValueError(
                    "it has no function infer(observation); write one that returns "
                    '{"actions": array of shape (H, A)}'
                )
        self._infer = infer
        self._reset: Callable[[], Any] | None = reset if callable(reset) else None

    @property
    def has_state(self) -> bool:
        """Whether the policy has a `reset`: then it serves one episode at a time."""
        return self._reset is not None

    def reset(self) -> None:
        """Begin an episode."""
        if self._reset is not None:
            self._call("reset", self._reset)

    def infer(self, observation: dict[Any, Any]) -> Any:
        """Return the policy's answer; raise a PolicyFailedError if it raises."""
        return self._call("infer", self._infer, observation)

    def _call(self, name: str, function: Any, *arguments: Any) -> Any:
        what = f"policy '{self.name}': {name}() failed"
        try:
            return function(*arguments)
        except FAILURES as error:
            check_failure(error, what)
            stack = stack_of(error)
            last = stack.rpartition("\n")[2]
            raise PolicyFailedError(f"{what}: {last} ({locate(error)})", stack) from error


def _attribute(policy: Any, name: str) -> Any:
    return getattr(policy, name, None)
