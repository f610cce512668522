# SPDX-License-Identifier: Apache-2.0

"""Find plug-ins by kind and name, and build them.

A plug-in is one file with a function `build(**parameters)`. Its name in a configuration is the file
name. A metric has no `build`, but `UNIT` and `measure(flight)`. Plug-ins are searched in three
places:

1. the package of the kind in cloudrc, without files whose name begins with an underscore;
2. installed packages with an entry point in the group `cloudrc.<kind>`;
3. a file, if the name is a path or ends in `.py`; `outside.code` loads it.
"""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from glob import escape, glob
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from cloudrc.base.errors import CloudrcError, MissingPrerequisiteError
from cloudrc.base.outside.code import calling, load_file
from cloudrc.base.outside.patience import telling_if_slow
from cloudrc.base.outside.refusal import check_names, naming
from cloudrc.base.outside.values import InvalidValueError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint  # its import takes longer than most commands

PACKAGE = Path(__file__).parents[1]
PACKAGES = {
    "estimators": "cloudrc.cloud.estimators",
    "predictors": "cloudrc.cloud.predictors",
    "controllers": "cloudrc.cloud.controllers",
    "perceptions": "cloudrc.cloud.perceptions",
    "onboard": "cloudrc.robots.onboard",
    "executors": "",
    "transports": "cloudrc.flight.pod.transports",
    "motion": "",
    "metrics": "",
    "policies": "",
}
"""Kind of plug-in -> package that contains cloudrc's plug-ins of this kind; "" if there is none:
cloudrc's metrics are functions, models of motion are files of robots, policies those of users.
The package of the executors is that of a guest, which calls `provide`."""
METHODS = {
    "estimators": ("horizon", "update", "add_applied"),
    "predictors": ("predict", "observe", "commanded", "applied", "reset"),
    "controllers": ("update", "reset"),
    "perceptions": ("see", "reset"),
    "onboard": ("update",),
    "motion": ("__call__",),
    "executors": ("action",),
}
"""Kind of plug-in -> the method that every plug-in of this kind defines, and further ones that are
called; the base class of the kind has them."""


class Found:
    """The file of a plug-in, or the object of an entry point."""

    def __init__(self, target: Any) -> None:
        """Give `target`, a module or the object of an entry point."""
        self._target = target

    @property
    def doc(self) -> str:
        """The first line of the docstring."""
        return (inspect.getdoc(self._target) or "").partition("\n")[0]

    @property
    def is_shipped(self) -> bool:
        """Whether it is a module of cloudrc, and not code of a user."""
        return f"{self.get('__name__')}".startswith("cloudrc.")

    @property
    def builder(self) -> Any:
        """What builds the plug-in: `build`, or the object of an entry point itself."""
        is_module = isinstance(self._target, ModuleType)
        return self.get("build") or (None if is_module else self._target)

    def get(self, name: str) -> Any:
        """Return what is called `name`; None if missing."""
        return getattr(self._target, name, None)

    @contextmanager
    def calling(self, name: str) -> Iterator[Callable[..., Any]]:
        """Give the function `name` to the block, which calls it and reads what it returns.

        A failure in the block is the user's, and gets file and line.
        """
        function = self.get(name)
        file = getattr(self._target, "__file__", None) or type(self._target).__name__
        slow = "" if self.is_shipped else f"{name}() of {file} is still running"
        with calling(f"{file}: {name}() failed", slow=slow):
            if function is None:
                raise ValueError("there is no such function; write one")
            yield function


def provide(kind: str, package: str) -> None:
    """Let the modules of a guest's `package` be cloudrc's plug-ins of a kind."""
    PACKAGES[kind] = package


def names(kind: str) -> list[str]:
    """List the names of all plug-ins of a kind, sorted, without importing them."""
    return sorted({*_shipped(kind), *_installed(kind)})


def installed(kind: str) -> dict[str, EntryPoint]:
    """Return name -> entry point of each plug-in of a kind of other packages; shipped names win."""
    shipped, entries = _shipped(kind), _installed(kind).items()
    return {
        name: entry
        for name, entry in entries
        if name not in shipped and not entry.module.startswith("cloudrc.")
    }


def describe(kind: str, name: str) -> str:
    """Return the first line of a plug-in's docstring, or why the plug-in cannot be loaded.

    A plug-in of cloudrc is read, not imported: an onboard controller would import MuJoCo.
    """
    module = _own_module(kind, name)
    if module:
        file = PACKAGE.joinpath(*module.split(".")[1:]).with_suffix(".py")
        return file.read_text("utf-8").split('"""', 2)[1].partition("\n")[0]
    try:
        return find(kind, name).doc
    except CloudrcError as error:
        return f"(not usable: {error})"


def signature(kind: str, name: str) -> inspect.Signature:
    """Return the parameters of a plug-in's `build`; their annotations are types, not strings."""
    build = builder(kind, name)
    with calling(f"{one(kind)} {name!r} has a build() with annotations that cannot be read"):
        return inspect.signature(build, eval_str=True)


def load(kind: str, name: str, /, **parameters: Any) -> Any:
    """Find a plug-in and build it."""
    build = builder(kind, name, look=False)
    slow = "" if _own_module(kind, name) else f"{name} is still being built"
    what = f"{one(kind)} {name!r} cannot be built"
    with calling(what, keep=MissingPrerequisiteError, slow=slow):
        plugin = build(**parameters)
        for method in METHODS[kind]:
            found = getattr(plugin, method, None)
            # The base class raises a NotImplementedError in the method that each plug-in defines.
            is_base = getattr(found, "__module__", None) == PACKAGES[kind]
            if not callable(found) or (is_base and method == METHODS[kind][0]):
                returned = f"build() returned {type(plugin).__name__}"
                raise ValueError(f"{returned}, which has no method {method}()")
    return plugin


def find(kind: str, name: str, *, look: bool = True) -> Found:
    """Import a plug-in by name or path.

    With `look`, the caller only looks at what the file defines; it neither builds nor measures.
    """
    own, what, in_file = _own_module(kind, name), f"{one(kind)} {name!r}", is_path(name)
    if not own and not in_file:
        check_names(one(kind), [name], names(kind))
    if in_file and not Path(name).is_file():
        with naming(what):
            raise InvalidValueError("there is no such file")
    with calling(f"{what} cannot be imported"):
        if own:
            return Found(importlib.import_module(own))
        if in_file:
            return Found(load_file(Path(name), look=look))
        # Last, because the search of all installed packages takes milliseconds.
        with telling_if_slow(f"{name} is still being imported"):
            return Found(_installed(kind)[name].load())


def is_path(name: str) -> bool:
    """Check whether the name of a plug-in is the path of a file."""
    return name.endswith(".py") or "/" in name or "\\" in name


def builder(kind: str, name: str, *, look: bool = True) -> Callable[..., Any]:
    """Return the function `build` of a plug-in, to `look` at it or to call it."""
    build = find(kind, name, look=look).builder
    if not callable(build):
        with calling(f"{one(kind)} {name!r}"):
            raise ValueError("has no function build(); write one that returns the plug-in")
    return build  # type: ignore[no-any-return]


def _shipped(kind: str) -> list[str]:
    return _modules(PACKAGES[kind]) if PACKAGES[kind] else []


@cache
def _modules(package: str) -> list[str]:
    """Return the names of the public modules of a package, which is not imported."""
    folder = PACKAGE.joinpath(*package.split(".")[1:])
    modules = pkgutil.iter_modules([str(folder)])
    return [module.name for module in modules if not module.name.startswith("_")]


def is_shipped(kind: str, name: str) -> bool:
    """Return whether a plug-in is a file of cloudrc: one of its kind, or of a shipped robot."""
    return bool(_own_module(kind, name))


def _own_module(kind: str, name: str) -> str:
    """Return the name of the module of cloudrc that is a plug-in; "" for one from elsewhere."""
    if not is_path(name):
        return f"{PACKAGES[kind]}.{name}" if name in _shipped(kind) else ""
    path = Path(name)
    if not path.is_relative_to(PACKAGE):
        return ""
    return ".".join(["cloudrc", *path.relative_to(PACKAGE).with_suffix("").parts])


def _installed(kind: str) -> dict[str, EntryPoint]:
    return _entries(kind, tuple(sys.path))


def versions_of(top: str) -> list[str]:
    """Return names and versions of the packages that have installed a top-level package."""
    from importlib.metadata import version

    return [f"{name} {version(name)}" for name in sorted({*_distributions().get(top, ())})]


@cache
def _distributions() -> Mapping[str, list[str]]:
    """Return top-level package -> names of the packages that have installed it."""
    from importlib.metadata import packages_distributions

    return packages_distributions()


@cache  # the search takes milliseconds, which every flight of a sweep would pay
def _entries(kind: str, path: tuple[str, ...]) -> dict[str, EntryPoint]:
    """Return the entry points of a kind in the packages on `path`, Python's search path."""
    if f"[cloudrc.{kind}]" not in _declared(path):
        return {}
    return {entry.name: entry for entry in _all_entries(path).select(group=f"cloudrc.{kind}")}


@cache
def _declared(path: tuple[str, ...]) -> str:
    """Return the text of all files with entry points."""
    files = (
        file
        for folder in path
        for file in glob(f"{escape(str(folder) or '.')}/*-info/entry_points.txt")
    )
    return "".join(Path(file).read_text("utf-8", "replace") for file in files)


@cache
def _all_entries(path: tuple[str, ...]) -> Any:
    from importlib.metadata import entry_points

    return entry_points()


def one(kind: str) -> str:
    """Return the word for one plug-in of a kind, such as "predictor"."""
    return "policy" if kind == "policies" else kind.removesuffix("s")
