# SPDX-License-Identifier: Apache-2.0

"""Make the observation that a policy wants from that of an environment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from cloudrc.base.outside.values import InvalidValueError

STATE = "observation/state"
"""Key of an observation that is no map."""
WHOLE = "."
"""Path of the whole observation."""


class Mapped(NamedTuple):
    """A key of the policy's observation: a part of the environment's, or a constant."""

    key: str
    path: str | None  # keys of the environment's observation, joined by dots; None: a constant
    value: Any = None


def observe(observation: Any, mapped: Sequence[Mapped] = ()) -> dict[str, Any]:
    """Return the policy's observation; without a map it has the keys of the environment's."""
    if not mapped:
        return dict(observation) if isinstance(observation, Mapping) else {STATE: observation}
    return {
        each.key: each.value if each.path is None else _part(observation, each.path)
        for each in mapped
    }


def _part(observation: Any, path: str) -> Any:
    found = observation
    for name in [] if path == WHOLE else path.split("."):
        if not isinstance(found, Mapping) or name not in found:
            has = f"; there are {', '.join(map(str, found))}" if isinstance(found, Mapping) else ""
            raise InvalidValueError(f"--map: the environment's observation has no '{path}'{has}")
        found = found[name]
    return found
