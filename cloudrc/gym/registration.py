# SPDX-License-Identifier: Apache-2.0

"""Environments that `gymnasium.make` makes by name, once `cloudrc.gym` is imported."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium

from cloudrc.base.outside.refusal import check_names
from cloudrc.gym.networked import Networked
from cloudrc.gym.options import ARGUMENTS
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
    "cloudrc/Linear-v0": {"entry_point": "cloudrc.gym.linear:Linear"},
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
    known = *ARGUMENTS, "env_args", "render_mode"
    check_names(f"argument of {NAME}", networked, known)
    inner = gymnasium.make(env, render_mode=render_mode, **(env_args or {}))
    return Networked(inner, **networked)


def make_vec(
    env: str = "", num_envs: int = 1, env_args: Mapping[str, Any] | None = None, **networked: Any
) -> NetworkedVector:
    """Make `num_envs` environments `env`, each behind a link of its own."""
    inner = gymnasium.make_vec(env, num_envs, **(env_args or {}))
    return NetworkedVector(inner, **networked)
