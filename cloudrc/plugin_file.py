"""Load the file of a plug-in; its import statements find the modules beside it.

Each plug-in becomes a package of its own, whose folder is that of the file: two plug-ins may each
have a module `helper` beside them, and `sys.path` stays as it is. The package's modules get their
own import statement, which looks beside the plug-in first, as Python does for a script. So a module
beside the plug-in may be named like one of Python, and only the plug-in sees it.

The name of the package has the path of the file: a process that a plug-in starts, for example by a
ProcessPoolExecutor, knows only this name, and imports the plug-in by it.
"""

from __future__ import annotations

import ast
import builtins
import importlib
import os
import sys
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections.abc import Iterator, Mapping, Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from io import BytesIO
from pathlib import Path
from tokenize import detect_encoding
from types import CodeType, ModuleType
from typing import Any, TypeAlias

from cloudrc.errors import PlacedError
from cloudrc.patience import telling_if_slow

PREFIX = f"{__name__}."
"""Beginning of the names of plug-ins' packages; the path of the file in hexadecimal follows."""
__path__: list[str] = []
"""Tells Python that this module contains others: plug-ins' packages."""
OWN = "cloudrc"
"""Name that always means this package: a plug-in may lie in the folder of its sources."""


_State: TypeAlias = list[tuple[Path, int, int]]
_unused: dict[Path, tuple[_State, ModuleType]] = {}
"""File of a plug-in -> the module that was executed for a look at it, and nothing built from."""


def load_file(path: Path, *, look: bool = False) -> ModuleType:
    """Execute the file of a plug-in, and the modules beside it that it imports.

    With `look`, the caller only looks at the module, so that the next call may return the same
    module. Else the next call executes the file anew: no flight sees what another has left there.
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
    file = path.resolve()
    name = PREFIX + os.fsencode(file).hex()
    for known in [each for each in sys.modules if f"{each}.".startswith(f"{name}.")]:
        del sys.modules[known]
    importlib.invalidate_caches()  # a file may be new
    importlib.import_module(name)
    inner = _inner(name, file)
    spec = spec_from_file_location(inner, path, loader=_Loader(inner, str(path)))
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    sys.modules[inner] = module  # dataclasses look up their module there
    spec.loader.exec_module(module)
    return module


def _inner(package: str, file: Path) -> str:
    """Return the name of the module of a plug-in's `file` in its package."""
    return f"{package}.{file.stem.replace('.', '_')}"


class _ImportStatement:
    """What `import` does in the modules of one plug-in."""

    def __init__(self, package: str, folder: str) -> None:
        self._package, self._folder = package, folder
        self._beside: dict[str, bool] = {OWN: False}

    def __call__(
        self,
        name: str,
        globals: Mapping[str, Any] | None = None,
        locals: Mapping[str, Any] | None = None,
        fromlist: Sequence[str] | None = (),
        level: int = 0,
    ) -> ModuleType:
        """Import a module as the built-in function `__import__` does."""
        top, more = name.partition(".")[0], fromlist or ()
        importer = globals or {}
        itself = importer.get("__name__") == f"{self._package}.{top}" and "__path__" not in importer
        if level or itself or not self._is_beside(top):
            return builtins.__import__(name, globals, locals, more, level)
        if more:
            return builtins.__import__(f"{self._package}.{name}", globals, locals, more, 0)
        importlib.import_module(f"{self._package}.{name}")
        return sys.modules[f"{self._package}.{top}"]

    def _is_beside(self, top: str) -> bool:
        """Return whether the module `top`, a name without dots, lies beside the plug-in."""
        if top not in self._beside:
            spec = PathFinder.find_spec(top, [self._folder])
            if spec is not None and spec.loader is None:  # a folder without __init__.py comes last
                spec = None if top in sys.modules or find_spec(top) else spec
            self._beside[top] = spec is not None
        return self._beside[top]


class _Loader(SourceFileLoader):
    """Executes a module of a plug-in with the plug-in's import statement."""

    def get_code(self, fullname: str) -> CodeType:
        """Compile the source; a cached file may be that of an earlier source."""
        path = self.get_filename(fullname)
        source = self.get_data(path)
        _check_encoding(source, Path(path).name)
        return self.source_to_code(source, path)

    def exec_module(self, module: ModuleType) -> None:
        """Execute a module."""
        package = sys.modules[_package_of(module.__name__)]
        own = {**vars(builtins), "__import__": package.__dict__["import_beside"]}
        module.__dict__["__builtins__"] = own
        super().exec_module(module)


def _check_encoding(source: bytes, name: str) -> None:
    """Raise a PlacedError if the source in the file `name` is not in the encoding that it has.

    Python refuses such a source, too, but names a wrong line.
    """
    if source.startswith((BOM_UTF16_LE, BOM_UTF16_BE)):
        raise PlacedError(f"{name}: is saved as UTF-16; save it as UTF-8")
    try:
        encoding, _ = detect_encoding(BytesIO(source).readline)
    except SyntaxError:  # an unknown encoding, or a byte that is not UTF-8 in the first two lines
        encoding = "utf-8"
    if not encoding.startswith("utf-8"):
        return
    try:
        source.decode()
    except UnicodeDecodeError as error:
        line = len((source[: error.start] + b"x").splitlines())
        raise PlacedError(
            f"{name}:{line}: is not saved as UTF-8 (byte 0x{source[error.start]:02x}); "
            "save it as UTF-8"
        ) from None


class _PackageLoader(Loader):
    """Gives the package of a plug-in its import statement."""

    def exec_module(self, module: ModuleType) -> None:
        """Set the import statement, which the modules of the package use."""
        statement = _ImportStatement(module.__name__, str(module.__path__[0]))
        module.__dict__["import_beside"] = statement


class _Finder(MetaPathFinder):
    """Finds the packages of plug-ins and their modules, and no others."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Find a module by its full name in the folders `path` of its package."""
        if path is None or not fullname.startswith(PREFIX):
            return None
        package = _package_of(fullname)
        file = Path(os.fsdecode(bytes.fromhex(package.removeprefix(PREFIX))))
        if fullname == package:
            spec = ModuleSpec(package, _PackageLoader(), is_package=True)
            spec.submodule_search_locations = [str(file.parent)]
            return spec
        if fullname == _inner(package, file):
            return spec_from_file_location(fullname, file, loader=_Loader(fullname, str(file)))
        found = PathFinder.find_spec(fullname, path, target)
        if found is not None and isinstance(found.loader, SourceFileLoader):
            found.loader = _Loader(fullname, found.loader.path)
        return found


def _package_of(module: str) -> str:
    """Return the name of the plug-in's package that contains a module, or that is the module."""
    return PREFIX + module.removeprefix(PREFIX).partition(".")[0]


sys.meta_path.insert(0, _Finder())  # before the finder of paths


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
