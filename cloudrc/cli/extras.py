"""The optional dependencies, and how to install those that are missing."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable

from cloudrc.errors import MissingPrerequisiteError

# Extra of pyproject.toml -> its modules; the distributions have the same names.
EXTRAS: dict[str, tuple[str, ...]] = {
    "world": ("mujoco",),
    "record": ("mcap", "rosbags", "zstandard"),
    "report": ("matplotlib",),
    "kube": ("kubernetes",),
    "api": ("fastapi", "uvicorn"),
}


def missing(extra: str) -> list[str]:
    """List the modules of an extra that are not installed; import none of them."""
    return [module for module in EXTRAS[extra] if importlib.util.find_spec(module) is None]


def require(purpose: str, extras: Iterable[str]) -> None:
    """Check that extras are installed.

    Args:
        purpose: What needs the extras, such as "mode virtual".
        extras: Names in `EXTRAS`.

    Raises:
        MissingPrerequisiteError: If a module is missing; the text says how to install it.
    """
    absent = {extra: missing(extra) for extra in extras}
    absent = {extra: modules for extra, modules in absent.items() if modules}
    if absent:
        modules = ", ".join(module for names in absent.values() for module in names)
        verb = "is" if modules.count(",") == 0 else "are"
        raise MissingPrerequisiteError(
            f"{purpose} needs {modules}, which {verb} not installed; "
            f"run: pip install 'cloudrc[{','.join(absent)}]'"
        )
