"""Environments that `gymnasium.make` makes by name, once `cloudrc.gym` is imported."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import gymnasium

from cloudrc.errors import BadInputError
from cloudrc.gym.networked import Networked
from cloudrc.gym.options import refuse_unknown
from cloudrc.gym.vector import NetworkedVector

NAME = "cloudrc/Networked-v0"
IDS: dict[str, dict[str, Any]] = {
    NAME: {
        "entry_point": "cloudrc.gym.registration:make",
        "vector_entry_point": "cloudrc.gym.registration:make_vec",
    },
    "cloudrc/Steps-v0": {
        "entry_point": "cloudrc.gym.testbed:RobotEnv",
        "kwargs": {"experiment": "steps"},
    },
    "cloudrc/Pipes-v0": {
        "entry_point": "cloudrc.gym.testbed:RobotEnv",
        "kwargs": {"experiment": "paper"},
    },
}
"""Name of an environment -> arguments of `gymnasium.register`."""


def register() -> None:
    """Register the environments, unless this is done already."""
    for name, arguments in IDS.items():
        if name not in gymnasium.registry:
            gymnasium.register(name, **arguments)


def make(
    env: str = "",
    env_args: Mapping[str, Any] | None = None,
    render_mode: str | None = None,
    **networked: Any,
) -> Networked:
    """Make `cloudrc/Networked-v0`: the environment `env` behind a link.

    `env_args` are arguments of the environment, all others those of `Networked`.
    """
    with _Told(env, networked):
        inner = gymnasium.make(env, render_mode=render_mode, **(env_args or {}))
    return Networked(inner, **networked)


def make_vec(
    env: str = "", num_envs: int = 1, env_args: Mapping[str, Any] | None = None, **networked: Any
) -> NetworkedVector:
    """Make `num_envs` environments `env`, each behind a link of its own."""
    with _Told(env, networked):
        inner = gymnasium.make_vec(env, num_envs, **(env_args or {}))
    return NetworkedVector(inner, **networked)


class _Told:
    """Refuse arguments that do not exist; convert gymnasium's error about an environment."""

    def __init__(self, env: str, networked: Iterable[str]) -> None:
        more = "; those of the environment go into env_args, a mapping"
        refuse_unknown(NAME, networked, more=more)
        if not env:
            raise BadInputError(f"{NAME}: give env=, the name of an environment")
        self._env = env

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: object, error: BaseException | None, stack: object) -> None:
        if isinstance(error, gymnasium.error.Error):
            raise BadInputError(f"env {self._env!r}: {error}") from error
