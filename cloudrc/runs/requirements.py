"""List optional dependencies, the modes that need them, and how to install missing packages."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable

from cloudrc.errors import MissingPrerequisiteError

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
}
"""Name of an extra in pyproject.toml -> the modules that it installs."""
PACKAGES = {"foxglove": "foxglove-sdk"}
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
    absent = {extra: found for extra in extras if (found := missing(extra))}
    if absent:
        modules = ", ".join(module for names in absent.values() for module in names)
        names = list(absent)
        if absent.keys() >= set(SIM):
            names = ["sim", *(name for name in absent if name not in SIM)]
        raise MissingPrerequisiteError(
            f"{purpose} needs {modules} (not installed); "
            f"run: pip install 'cloudrc[{','.join(names)}]'"
        )


def name_extra(error: ModuleNotFoundError) -> MissingPrerequisiteError | None:
    """Return the error that names the extra with a module that was not found; None if none has it.

    For what loads a module of an extra before it knows whether it needs the extra.
    """
    module = (error.name or "").partition(".")[0]
    for extra, modules in EXTRAS.items():
        if module in modules:
            named = "sim" if extra in SIM else extra
            return MissingPrerequisiteError(
                f"this needs {module} (not installed); run: pip install 'cloudrc[{named}]'"
            )
    return None
