# SPDX-License-Identifier: Apache-2.0

"""Users' code: load it from a file, and tell its failures from those of cloudrc.

It runs as Python runs it. What it raises, also SystemExit, is its own failure, which names its file
and line; Ctrl-C, a lack of memory and the loss of a program outside pass through. What it prints
goes to stderr, because stdout has the result of the command.

The folder of a file comes last in Python's search path, so that no module beside it hides one of
Python or of an installed package. Each load executes the file and the modules beside it anew: no
flight sees what another one has left there, and two files may each have a module `helper`.
"""

from __future__ import annotations

import ast
import gc
import importlib
import os
import sys
import sysconfig
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, redirect_stdout
from importlib.machinery import PathFinder
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any, TypeAlias

from cloudrc.base.errors import (
    BadInputError,
    CloudrcError,
    ControllerLostError,
    OutOfMemoryError,
    PlacedError,
    describe_error,
)
from cloudrc.base.outside.patience import telling_if_slow

PREFIX = "cloudrc_file_"
"""Beginning of the names of users' modules; the stem of the file follows."""
OWN = "cloudrc"
"""Name that always means this package: a user's file may lie in the folder of its sources."""
FAILURES = Exception, SystemExit
"""What counts as a failure of a user's code; Ctrl-C, which is the user's, does not."""
STACK_MAX = 4000
"""Largest length of a failure's stack in the recording [characters]."""

_State: TypeAlias = list[tuple[Path, int, int]]
_unused: dict[Path, tuple[_State, ModuleType]] = {}
"""File -> the module that was executed for a look at it, and nothing built from."""
_folders: list[str] = []
"""Folders of the files that this process has loaded; they are in Python's search path."""
_beside = set[str]()
"""Names of the modules beside files, of which the next load does not know anything."""
INSTALLED = (
    *(sysconfig.get_path(name) + os.sep for name in ("stdlib", "platstdlib", "purelib", "platlib")),
    f"{Path(__file__).parents[2]}{os.sep}",
)
"""Folders of Python, of installed packages, and of cloudrc: files elsewhere are those of users."""


def check_failure(error: BaseException, what: str) -> None:
    """Return if `error` is a failure of users' code; raise it, or an error about it, if it is not.

    A lack of memory is the machine's: no result may depend on it. The loss of a program outside
    ends a flight. `what` names the code in the error's text.
    """
    if isinstance(error, OutOfMemoryError | ControllerLostError):
        raise error
    if isinstance(error, MemoryError):
        text = f"{what}: memory ran out ({describe_error(error)})"
        raise OutOfMemoryError(f"{text}; let it use less memory, or free some") from error


@contextmanager
def apart() -> Iterator[None]:
    """Call users' code inside the block: what it prints goes to stderr."""
    with redirect_stdout(sys.stderr):
        yield


def attempt(call: Callable[[], Any]) -> tuple[Any, BaseException | None]:
    """Call users' code; return its result and its failure, one of which is None."""
    try:
        return call(), None
    except FAILURES as error:
        return None, error


@contextmanager
def calling(
    what: str, *, keep: type[CloudrcError] | tuple[()] = (), slow: str = ""
) -> Iterator[None]:
    """Call users' code inside the block; its failure becomes a BadInputError.

    `what` says which code failed to do what. Use it before a flight and between flights; in flight,
    cloud goes on. Errors of the kind `keep`, which the block's other code raises, stay as they are.
    `slow` is the text to log if the block takes long; "" for none.
    """
    try:
        with redirect_stdout(sys.stderr), telling_if_slow(slow) if slow else nullcontext():
            yield
    except keep:
        raise
    except FAILURES as error:
        check_failure(error, what)
        raise BadInputError(f"{what}: {place_of(error)}{_explain(error)}") from error


def place_of(error: BaseException) -> str:
    """Return file and line where a user's own code failed, to put before the error's text.

    Return "" if the user's code did not fail, or if the text names the place already.
    """
    own = _own_frames(error)
    if not own or isinstance(error, SyntaxError | PlacedError):
        return ""
    return f"{Path(own[-1].filename).name}:{own[-1].lineno}: "


def locate(error: BaseException) -> str:
    """Return file, line and function where a user's code failed.

    Prefer the last line of the user's own file to that of a library that it calls.
    """
    frames = _own_frames(error) or traceback.extract_tb(error.__traceback__)
    return f"{Path(frames[-1].filename).name}:{frames[-1].lineno} in {frames[-1].name}"


def stack_of(error: BaseException) -> str:
    """Return the stack of a failure as Python prints it, shortened from the front."""
    frames = "".join(traceback.format_tb(error.__traceback__))[-STACK_MAX:]
    return frames.encode(errors="replace").decode() + describe_error(error)


def _own_frames(error: BaseException) -> list[traceback.FrameSummary]:
    """Return the calls in users' files that `error` left, innermost last.

    A generated method, such as that of a dataclass, has no line that a user could look at.
    """
    frames = traceback.extract_tb(error.__traceback__)
    return [each for each in frames if each.filename[:1] != "<" and not is_installed(each.filename)]


def _explain(error: BaseException) -> str:
    """Describe an exception in one line, without its type if it was raised to inform the user."""
    described = describe_error(error)
    if isinstance(error, ValueError | CloudrcError):
        return described.partition(": ")[2] or described
    return described


def load_file(path: Path, *, look: bool = False) -> ModuleType:
    """Execute a file, and the modules beside it that it imports.

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
    """Return what changes with any of the files."""
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


def free_unused() -> None:
    """Free the memory of users' modules from which nothing is left: a file may hold much data."""
    for name in [each for each in sys.modules if each.startswith(PREFIX)]:
        del sys.modules[name]
    gc.collect()  # a module and its functions refer to each other


@contextmanager
def _importing_beside(folder: str) -> Iterator[None]:
    """Let the block import modules of `folder`, and none that another file has beside it."""
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
    """Return a file and all files beside it that it names.

    It names modules in its import statements, and data files as texts, such as "gains.json".
    `folders` are the places of modules, if they are others than that of the file.
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
