"""Finds plug-ins: a kind and a configuration name go in, what its `build` makes comes out.

A plug-in is one file with a function `build(**parameters)`; the file's name is its configuration
name. (A metric has no `build`: see `cloudrc.metrics`.) Three places are searched: the kind's
package here, where files that start with an underscore are no plug-ins; installed packages that
name one in the entry-point group `cloudrc.<kind>`; and, for a name that is a path or ends in `.py`,
that file.
"""

from __future__ import annotations

import difflib
import importlib
import importlib.util
import inspect
import pkgutil
import sys
from collections.abc import Callable
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType
from typing import Any

from cloudrc.errors import BadInputError, CloudrcError

PACKAGES = {
    "estimators": "cloudrc.cloud.estimators",
    "predictors": "cloudrc.cloud.predictors",
    "controllers": "cloudrc.cloud.controllers",
    "metrics": "",
}
"""Kind of plug-in -> the package whose files are plug-ins of it; metrics ship as rows of tables."""


def names(kind: str) -> list[str]:
    """List the configuration names of a kind, sorted; nothing but its package is imported."""
    return sorted({*_shipped(kind), *_installed(kind)})


def describe(kind: str, name: str) -> str:
    """Give the first line of a plug-in's docstring, or why it cannot be loaded."""
    try:
        target = find(kind, name)
    except CloudrcError as error:
        return f"(not usable: {error})"
    return (inspect.getdoc(target) or "").partition("\n")[0]


def signature(kind: str, name: str) -> inspect.Signature:
    """Give the parameters of a plug-in's `build`, their annotations evaluated."""
    build = _build(kind, name)
    try:
        return inspect.signature(build, eval_str=True)
    except Exception as error:
        raise BadInputError(
            f"{_one(kind)} {name!r}: annotations of build() cannot be read: {error}"
        ) from error


def load(kind: str, name: str, **parameters: Any) -> Any:
    """Build a plug-in.

    Args:
        kind: One of `PACKAGES`.
        name: Configuration name, or the path of a file.
        **parameters: For its `build`; names and types are those of its signature.

    Raises:
        BadInputError: If there is no such plug-in, or its `build` refuses the parameters.
    """
    build = _build(kind, name)
    try:
        return build(**parameters)
    except Exception as error:  # a stranger's code: whatever it raises, the user reads one line
        raise BadInputError(f"{_one(kind)} {name!r} cannot be built: {_reason(error)}") from error


def find(kind: str, name: str) -> Any:
    """Import a plug-in.

    Args:
        kind: One of `PACKAGES`.
        name: Configuration name, or the path of a file.

    Returns:
        Its module; for an entry point, what that names.
    """
    try:
        if is_path(name):
            return _load_file(kind, Path(name))
        if name in _shipped(kind):
            return importlib.import_module(f"{PACKAGES[kind]}.{name}")
        installed = _installed(kind)
        if name in installed:
            return installed[name].load()
    except CloudrcError:
        raise
    except Exception as error:  # as in load
        raise BadInputError(
            f"{_one(kind)} {name!r} cannot be imported: {_reason(error)}"
        ) from error
    raise BadInputError(unknown(_one(kind), name, names(kind)))


def is_path(name: str) -> bool:
    """Say whether a configuration name means a file outside the package."""
    return name.endswith(".py") or "/" in name or "\\" in name


def unknown(what: str, name: str, available: list[str]) -> str:
    """Word the refusal of a name: what there is, and what may have been meant."""
    there = ", ".join(available) or "none"
    return f"no {what} named {name!r}; available: {there}{meant(name, available)}"


def meant(name: str, available: list[str]) -> str:
    """Say which name may have been meant, to be put behind a refusal; "" if none is near."""
    near = difflib.get_close_matches(name, available, n=1)
    return f"; did you mean {near[0]}?" if near else ""


def _build(kind: str, name: str) -> Callable[..., Any]:
    target = find(kind, name)
    build = getattr(target, "build", None if isinstance(target, ModuleType) else target)
    if not callable(build):
        raise BadInputError(
            f"{_one(kind)} {name!r} has no function build(); write one that returns the plug-in"
        )
    return build  # type: ignore[no-any-return]


def _shipped(kind: str) -> list[str]:
    if kind not in PACKAGES:
        raise BadInputError(unknown("kind of plug-in", kind, list(PACKAGES)))
    if not PACKAGES[kind]:
        return []
    package = importlib.import_module(PACKAGES[kind])
    return [
        module.name
        for module in pkgutil.iter_modules(package.__path__)
        if not module.ispkg and not module.name.startswith("_")
    ]


def _installed(kind: str) -> dict[str, EntryPoint]:
    return {entry.name: entry for entry in entry_points(group=f"cloudrc.{kind}")}


def _load_file(kind: str, path: Path) -> ModuleType:
    if not path.is_file():
        raise BadInputError(f"{_one(kind)} {str(path)!r}: there is no such file")
    # The path is in the name: two files of one name are two plug-ins.
    module_name = f"cloudrc_plugin:{path.resolve()}"
    spec = importlib.util.spec_from_file_location(module_name, path)
    if spec is None or spec.loader is None:
        raise BadInputError(f"{_one(kind)} {str(path)!r} is not a Python file; name it *.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[module_name] = module  # dataclasses look their module up there
    spec.loader.exec_module(module)
    return module


def _one(kind: str) -> str:
    return kind.removesuffix("s")


def _reason(error: Exception) -> str:
    text = " ".join(str(error).split())
    return text if isinstance(error, ValueError) and text else f"{type(error).__name__}: {text}"
