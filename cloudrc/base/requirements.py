# SPDX-License-Identifier: Apache-2.0

"""List optional dependencies, the modes that need them, and how to install missing packages."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable

from cloudrc.base.errors import MissingPrerequisiteError

EXTRAS: dict[str, tuple[str, ...]] = {
    "world": ("mujoco",),
    "record": ("mcap", "rosbags"),
    "report": ("matplotlib",),
    "kube": ("kubernetes",),
    "api": ("fastapi", "uvicorn"),
    "console": ("starlette", "uvicorn", "viser"),
    "policy": ("msgpack", "websockets"),
    "gym": ("gymnasium",),
    "foxglove": ("foxglove",),
    "mpc": ("daqp",),
    "bucket": ("s3fs",),
    "camera": ("av",),
    "rank": ("foundation_policy",),
    "arms": ("metaworld",),
}
"""Name of an extra in pyproject.toml -> the modules that it installs."""
PACKAGES = {"foxglove": "foxglove-sdk", "foundation_policy": "foundation-policy"}
"""Module -> its package, where the names differ."""
MODES: dict[str, tuple[str, ...]] = {
    "local": ("world", "record", "report", "api"),
    "virtual": ("world", "record", "report"),
    "cluster": ("kube", "record", "report"),
}
"""Mode of a run -> the extras that it needs."""
SIM = MODES["virtual"]
"""The extras that the extra `sim` combines."""


def missing(extra: str) -> list[str]:
    """List the modules of an extra that are not installed, without importing any module."""
    return [module for module in EXTRAS[extra] if importlib.util.find_spec(module) is None]


def require(purpose: str, extras: Iterable[str]) -> None:
    """Raise a MissingPrerequisiteError unless all `extras` are installed.

    `purpose`, such as "mode virtual", is for the error text.
    """
    if absent := {extra: found for extra in extras if (found := missing(extra))}:
        raise _error(purpose, [module for found in absent.values() for module in found], absent)


def name_extra(error: ModuleNotFoundError) -> MissingPrerequisiteError | None:
    """Return the error that names the extra with a module that was not found; None if none has it.

    For what loads a module of an extra before it knows whether it needs the extra.
    """
    module = (error.name or "").partition(".")[0]
    named = [extra for extra, modules in EXTRAS.items() if module in modules]
    return _error("this", [module], named[:1]) if named else None


def _error(purpose: str, modules: Iterable[str], extras: Iterable[str]) -> MissingPrerequisiteError:
    extras = list(extras)
    if set(SIM) <= set(extras):
        extras = ["sim", *(extra for extra in extras if extra not in SIM)]
    return MissingPrerequisiteError(
        f"{purpose} needs {', '.join(modules)} (not installed); "
        f"run: pip install 'cloudrc[{','.join(extras)}]'"
    )
