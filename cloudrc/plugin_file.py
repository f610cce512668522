"""Load the file of a plug-in; its import statements find the modules beside it.

The folder of the file comes last in Python's search path, so that no module beside a plug-in hides
one of Python or of an installed package. Each load executes the file and the modules beside it
anew: no flight sees what another one has left there, and two plug-ins may each have a module
`helper`.
"""

from __future__ import annotations

import ast
import importlib
import os
import sys
import sysconfig
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.machinery import PathFinder
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import TypeAlias

from cloudrc.patience import telling_if_slow

PREFIX = "cloudrc_file_"
"""Beginning of the names of plug-ins' modules; the stem of the file follows."""
OWN = "cloudrc"
"""Name that always means this package: a plug-in may lie in the folder of its sources."""

_State: TypeAlias = list[tuple[Path, int, int]]
_unused: dict[Path, tuple[_State, ModuleType]] = {}
"""File of a plug-in -> the module that was executed for a look at it, and nothing built from."""
_folders: list[str] = []
"""Folders of the plug-ins that this process has loaded; they are in Python's search path."""
_beside = set[str]()
"""Names of the modules beside plug-ins, of which the next load does not know anything."""
INSTALLED = (
    *(sysconfig.get_path(name) + os.sep for name in ("stdlib", "platstdlib", "purelib", "platlib")),
    os.path.dirname(__file__) + os.sep,
)
"""Folders of Python, of installed packages, and of cloudrc: files elsewhere are those of users."""


def load_file(path: Path, *, look: bool = False) -> ModuleType:
    """Execute the file of a plug-in, and the modules beside it that it imports.

    With `look`, the caller only looks at the module, so that the next call may return the same
    module. Else the next call executes the file anew.
    """
    if path.suffix != ".py":
        raise ValueError("it is not a Python file; name it *.py")
    file, state = path.resolve(), _state(path)
    before, module = _unused.pop(file, (None, None))
    if module is None or before != state:
        with telling_if_slow(f"{path} is still being imported"):
            module = _execute(path)
    if look:
        _unused[file] = state, module
    return module


def _state(path: Path) -> _State:
    """Return what changes with any of the plug-in's files."""
    states = [(file, file.stat()) for file in sources(path)]
    return [(file, each.st_mtime_ns, each.st_size) for file, each in states]


def _execute(path: Path) -> ModuleType:
    name = PREFIX + path.stem
    spec = spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    with _importing_beside(str(path.resolve().parent)):
        sys.modules[name] = module  # dataclasses look up their module there
        spec.loader.exec_module(module)
    return module


@contextmanager
def _importing_beside(folder: str) -> Iterator[None]:
    """Let the block import modules of `folder`, and none that another plug-in has beside it."""
    while _beside:
        sys.modules.pop(_beside.pop(), None)
    importlib.invalidate_caches()  # a file may be new
    others = [each for each in _folders if each != folder]
    sys.path[:] = [each for each in sys.path if each not in others]
    if folder not in sys.path:
        sys.path.append(folder)
        _folders.append(folder)
    # A cached file may be that of an earlier source of the same second.
    writes, sys.dont_write_bytecode = sys.dont_write_bytecode, True
    known = {*sys.modules}
    try:
        yield
    finally:
        sys.dont_write_bytecode = writes
        sys.path += others
        for name in {*sys.modules} - known:
            file = str(getattr(sys.modules[name], "__file__", None))
            if file.startswith(folder + os.sep) and not is_installed(file):
                _beside.add(name)


def is_installed(path: str) -> bool:
    """Return whether a path is one of Python or of installed packages."""
    inside = f"{path}{os.sep}".startswith(INSTALLED)
    return inside or not {"site-packages", "dist-packages"}.isdisjoint(Path(path).parts)


def sources(path: Path, folders: list[str] | None = None) -> list[Path]:
    """Return the file of a plug-in and all files beside it that it names.

    It names modules in its import statements, and data files as texts, such as "gains.json". For a
    file that is no plug-in, `folders` are the places of modules.
    """
    file = path.resolve()
    found, left = {file: path}, [file]
    while left:
        for other in _named(left.pop(), folders or [str(file.parent)]):
            if other not in found:
                found[other] = other
                left.append(other)
    return list(found.values())


def _named(file: Path, folders: list[str]) -> Iterator[Path]:
    """Yield the files that the source `file` names: modules in `folders`, data files beside it."""
    try:
        nodes = [*ast.walk(ast.parse(file.read_bytes()))] if file.suffix == ".py" else []
    except (OSError, SyntaxError, ValueError, RecursionError):
        return
    for node in nodes:
        yield from _named_by(node, file, folders)


def _named_by(node: ast.AST, file: Path, folders: list[str]) -> Iterator[Path]:
    """Yield the files that one node of the syntax tree of `file` names."""
    match node:
        case ast.Import(names=names):
            for alias in names:
                yield from _files(folders, alias.name)
        case ast.ImportFrom(module=module, names=names, level=level):
            above = [str([*file.parents][:level][-1])] if level else folders
            for alias in names:
                yield from _files(above, f"{module or ''}.{alias.name}".lstrip("."))
        case ast.Constant(value=str(text)):
            data = os.path.join(file.parent, text)
            if not os.path.isabs(text) and os.path.isfile(data):  # unlike Path, never raises
                yield Path(data).resolve()


def _files(folders: list[str], name: str) -> Iterator[Path]:
    """Yield the files of a module and of the packages that contain it, as far as they exist."""
    places: list[str] | None = folders
    for part in name.split("."):
        spec = PathFinder.find_spec(part, places) if places and part != OWN else None
        if spec is None:
            return
        if spec.origin is not None and Path(spec.origin).is_file():
            yield Path(spec.origin).resolve()
        places = list(spec.submodule_search_locations or ())
