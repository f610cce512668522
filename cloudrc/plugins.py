"""Find plug-ins by kind and name, and build them.

A plug-in is one file with a function `build(**parameters)`. Its name in a configuration is the file
name. A metric has no `build`, but `UNIT` and `measure(flight)`. Plug-ins are searched in three
places:

1. the package of the kind in cloudrc, without files whose name begins with an underscore;
2. installed packages with an entry point in the group `cloudrc.<kind>`;
3. a file, if the name is a path or ends in `.py`; `plugin_file` loads it.

Plug-ins are code of the user, which may raise anything and may call `sys.exit()`. `check_failure`
decides what is a failure of a plug-in; all parts of cloudrc that call plug-ins use it. `apart`
keeps the working folder and the standard streams of the command. `find` returns a `Found`, through
which alone a caller reaches what the file of a plug-in defines.
"""

from __future__ import annotations

import ast
import difflib
import importlib
import inspect
import operator
import os
import pkgutil
import re
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from functools import cache
from importlib.metadata import EntryPoint, entry_points, packages_distributions, version
from importlib.util import find_spec
from numbers import Real
from pathlib import Path
from types import CodeType, FrameType, ModuleType
from typing import TYPE_CHECKING, Any

from cloudrc.errors import (
    BadInputError,
    CloudrcError,
    ControllerLostError,
    OutOfMemoryError,
    PlacedError,
    describe_error,
    to_one_line,
)
from cloudrc.patience import telling_if_slow
from cloudrc.plugin_file import PREFIX, is_installed, load_file
from cloudrc.text import unknown_name_text

if TYPE_CHECKING:
    from numpy.typing import NDArray

PACKAGES = {
    "estimators": "cloudrc.cloud.estimators",
    "predictors": "cloudrc.cloud.predictors",
    "controllers": "cloudrc.cloud.controllers",
    "onboard": "cloudrc.robots.onboard",
    "executors": "cloudrc.gym.executors",
    "motion": "",
    "metrics": "",
    "policies": "",
}
"""Kind of plug-in -> package that contains cloudrc's plug-ins of this kind; "" if there is none:
cloudrc's metrics are functions, models of motion are files of robots, policies those of users."""
SHOWN_MAX = 60
"""Largest length of a wrong value's representation in a message [characters]."""
LARGEST = 1e30
"""Largest size of a number that a plug-in returns, and largest length of several [any unit].
Metrics square numbers, and the page of the report stores some with single precision: a much larger
number overflows there."""
STACK_MAX = 4000
"""Largest length of a failure's stack in the recording [characters]."""
METHODS = {
    **{"estimators": "horizon", "predictors": "predict", "controllers": "update"},
    **{"onboard": "update", "motion": "__call__", "executors": "action"},
}
"""Kind of plug-in -> the method that every plug-in of this kind defines."""
INHERITED = {
    "estimators": ("update", "add_applied"),
    "predictors": ("observe", "commanded", "applied", "reset"),
    "controllers": ("reset",),
}
"""Kind of plug-in -> further methods that cloud calls; the base class of the kind has them."""


class Found:
    """The file of a plug-in, or the object of an entry point: the guarded way to what it defines.

    A file may define anything, also a `__getattr__` that fails, so no caller reads it directly.
    """

    def __init__(self, target: Any) -> None:
        """Guard `target`, a module or the object of an entry point."""
        self._target = target

    @property
    def doc(self) -> str:
        """The first line of the docstring."""
        return (inspect.getdoc(self._target) or "").partition("\n")[0]

    @property
    def is_shipped(self) -> bool:
        """Whether it is a module of cloudrc, and not code of a user."""
        name = str(getattr(self._target, "__name__", ""))
        is_module = isinstance(self._target, ModuleType)
        return is_module and name.startswith("cloudrc.")

    @property
    def builder(self) -> Any:
        """What builds the plug-in: `build`, or the object of an entry point itself."""
        build = self.get("build")
        is_module = isinstance(self._target, ModuleType)
        return self._target if build is None and not is_module else build

    def get(self, name: str) -> Any:
        """Return what is called `name`, to look at it or to call it in a guard; None if missing.

        Raises:
            BadInputError: If it cannot be read.
        """
        with self._refusing(name, None, "cannot be read"):
            return getattr(self._target, name, None)

    @contextmanager
    def calling(self, name: str) -> Iterator[Callable[..., Any]]:
        """Give the function `name` to the block, which calls it and reads what it returns.

        A failure in the block is the user's: it becomes a BadInputError with file and line.
        """
        function = self.get(name)
        file = getattr(self._target, "__file__", None) or type(self._target).__name__
        with (
            self._refusing(f"{name}()", function, "failed"),
            telling_if_slow(f"{name}() of {file} is still running"),
        ):
            if function is None:
                raise ValueError("there is no such function; write one")
            yield function

    @contextmanager
    def _refusing(self, name: str, function: Any, verb: str) -> Iterator[None]:
        try:
            with apart():
                yield
        except FAILURES as error:
            what = f"{self._place(error, function)}: {name} {verb}"
            check_failure(error, what)
            raise BadInputError(f"{what}: {_explain(error)}") from error

    def _place(self, error: BaseException, function: Any) -> str:
        """Return file and line: where a plug-in's own code failed, else where `function` begins."""
        file = getattr(self._target, "__file__", None) or type(self._target).__name__
        own = [(frame.f_code.co_filename, line) for frame, line in _own_frames(error, file)]
        code = getattr(function, "__code__", None)
        if not own and isinstance(code, CodeType):
            own = [(code.co_filename, code.co_firstlineno)]
        return f"{own[-1][0]}:{own[-1][1]}" if own else str(file)


def _own_frames(error: BaseException, file: str = "") -> list[tuple[FrameType, int]]:
    """Return frame and line of each call in a user's files that `error` left, innermost last.

    They are the files of plug-ins, those beside them, `file`, and all others that are not
    installed, such as the module of an environment. A frame without a file, such as in a method
    that a dataclass generates, has no line that a user could look at.
    """

    def is_own(frame: FrameType) -> bool:
        name, own = (str(frame.f_globals.get(key)) for key in ("__name__", "__file__"))
        if frame.f_code.co_filename[:1] == "<":
            return False
        return name.startswith(PREFIX) or own == file or not is_installed(own)

    return [each for each in traceback.walk_tb(error.__traceback__) if is_own(each[0])]


def names(kind: str) -> list[str]:
    """List the names of all plug-ins of a kind, sorted, without importing them."""
    return sorted({*_shipped(kind), *_installed(kind)})


def installed(kind: str) -> dict[str, EntryPoint]:
    """Return name -> entry point of each installed plug-in of a kind; shipped names win."""
    shipped = _shipped(kind)
    return {name: entry for name, entry in _installed(kind).items() if name not in shipped}


def describe(kind: str, name: str) -> str:
    """Return the first line of a plug-in's docstring, or why the plug-in cannot be loaded.

    A plug-in of cloudrc is read, not imported: an onboard controller would import MuJoCo.
    """
    is_shipped = name in _shipped(kind)
    module = f"{PACKAGES[kind]}.{name}" if is_shipped else is_path(name) and _module_of(Path(name))
    if module and (spec := find_spec(module)) is not None and spec.origin is not None:
        tree = ast.parse(Path(spec.origin).read_text("utf-8"))
        return (ast.get_docstring(tree) or "").partition("\n")[0]
    try:
        return find(kind, name).doc
    except CloudrcError as error:
        return f"(not usable: {error})"


def signature(kind: str, name: str) -> inspect.Signature:
    """Return the parameters of a plug-in's `build`; their annotations are types, not strings."""
    build = builder(kind, name)
    with refuse_failure(f"{one(kind)} {name!r} has a build() with annotations that cannot be read"):
        found = inspect.signature(build, eval_str=True)
    if "name" in found.parameters:
        raise BadInputError(
            f"{one(kind)} {name!r}: no parameter of build() may be called name, because the key "
            "name is the plug-in itself; call it something else"
        )
    return found


def load(kind: str, name: str, /, **parameters: Any) -> Any:
    """Find a plug-in and build it; raise a BadInputError if it is missing or its `build` fails."""
    build = builder(kind, name, look=False)
    what = f"{one(kind)} {name!r} cannot be built"
    with refuse_failure(what, slow=f"{name} is still being built"):
        plugin = build(**parameters)
        _check_methods(kind, plugin)
    return plugin


def _check_methods(kind: str, plugin: Any) -> None:
    """Raise a ValueError if an object that `build` returned lacks a method of its kind."""
    name = one(kind).capitalize()
    base = getattr(importlib.import_module(PACKAGES[kind] or "cloudrc"), name, None)
    for method in (METHODS[kind], *INHERITED.get(kind, ())):
        found = getattr(plugin, method, None)
        if callable(found) and not _is_described(found, getattr(base, METHODS[kind], None)):
            continue
        near = _suggest_method(type(plugin), base, method)
        if not near and method in INHERITED.get(kind, ()):
            near = f"; derive its class from {PACKAGES[kind]}.{name}"
        raise _no_method(type(plugin), f"no method {method}(){near}")


def _is_described(found: Any, method: Any) -> bool:
    """Return whether `found` is a `method` that the base class of a kind describes only.

    The base class raises a NotImplementedError there.
    """
    return method is not None and getattr(found, "__func__", found) is method


def _suggest_method(own: type, base: Any, method: str) -> str:
    """Return a suggestion of the method that a user may have misspelt as `method`; or ""."""
    added = [name for name in dir(own) if not hasattr(base, name) and name != method]
    near = difflib.get_close_matches(method, added, n=1)
    return f"; it has {near[0]}()" if near else ""


def _no_method(own: type, lacking: str) -> ValueError:
    """Return the error about the class of what `build` returned; it names the file of a user."""
    file = getattr(sys.modules.get(own.__module__), "__file__", None)
    if own.__module__.startswith(PREFIX) and file:
        return PlacedError(f"{Path(file).name}: {own.__name__} has {lacking}")
    return ValueError(f"build() returned {own.__name__}, which has {lacking}")


def find(kind: str, name: str, *, look: bool = True) -> Found:
    """Import a plug-in by name or path.

    With `look`, the caller only looks at what the file defines; it neither builds nor measures.
    """
    if is_path(name) and not Path(name).is_file():
        near = _suggest_file(Path(name))
        raise BadInputError(f"{one(kind)} {name!r}: there is no such file{near}")
    with refuse_failure(f"{one(kind)} {name!r} cannot be imported"):
        if is_path(name):
            if (module := _module_of(Path(name))) is not None:
                return Found(importlib.import_module(module))
            return Found(load_file(Path(name), look=look))
        if name in _shipped(kind):
            return Found(importlib.import_module(f"{PACKAGES[kind]}.{name}"))
        # Last, because the search of all installed packages takes milliseconds.
        if (entry := _installed(kind).get(name)) is not None:
            with telling_if_slow(f"{name} is still being imported"):
                return Found(entry.load())
    raise BadInputError(unknown_name_text(one(kind), name, names(kind)))


FAILURES = Exception, SystemExit
"""What counts as a failure of a user's code; Ctrl-C, which is the user's, does not."""


def check_failure(error: BaseException, what: str) -> None:
    """Return if `error`, which a plug-in raised, is the plug-in's failure; else raise.

    All `FAILURES` are, except a lack of memory, which is the machine's: no result may depend on it;
    and except the loss of a program outside, which ends a flight. `what` names the plug-in in the
    error's text.
    """
    if isinstance(error, OutOfMemoryError | ControllerLostError):
        raise error
    if isinstance(error, MemoryError):
        text = f"{what}: memory ran out ({describe_error(error)})"
        raise OutOfMemoryError(f"{text}; let it use less memory, or free some") from error


@contextmanager
def apart() -> Iterator[None]:
    """Call plug-ins inside the block: what they print goes to stderr, as stdout has the result.

    Afterwards, working folder and standard streams are again those before the block.
    """
    folder, out, err = os.getcwd(), sys.stdout, sys.stderr
    sys.stdout = err
    try:
        yield
    finally:
        sys.stdout, sys.stderr = out, err
        os.chdir(folder)


@contextmanager
def refuse_failure(
    what: str, *, keep: type[CloudrcError] | tuple[()] = (), slow: str = ""
) -> Iterator[None]:
    """Convert the failure of a plug-in to a BadInputError; `what` says which one failed to do what.

    Use it before a flight and between flights; in flight, cloud goes on. Errors of the kind `keep`,
    which the block's other code raises, stay as they are. `slow` is the text to log if the block
    takes long; "" for none.
    """
    try:
        with apart(), telling_if_slow(slow) if slow else nullcontext():
            yield
    except keep:
        raise
    except FAILURES as error:
        check_failure(error, what)
        raise BadInputError(f"{what}: {place_of(error)}{_explain(error)}") from error


def place_of(error: BaseException) -> str:
    """Return file and line where a user's own code failed, to put before the error's text.

    Return "" if the user's code did not fail, or if Python's text names the place already.
    """
    own = _own_frames(error)
    if not own or isinstance(error, SyntaxError | PlacedError):
        return ""
    frame, line = own[-1]
    return f"{Path(frame.f_code.co_filename).name}:{line}: "


def locate(error: BaseException) -> str:
    """Return file, line and function where a plug-in failed.

    Prefer the last line of a plug-in's own file to that of a library that it calls.
    """
    frames = [*traceback.walk_tb(error.__traceback__)]
    frame, line = (_own_frames(error) or frames)[-1]
    return f"{Path(frame.f_code.co_filename).name}:{line} in {frame.f_code.co_name}"


def stack_of(error: BaseException) -> str:
    """Return the stack of a plug-in's failure as Python prints it, shortened from the front."""
    frames = "".join(traceback.format_tb(error.__traceback__))[-STACK_MAX:]
    return frames.encode(errors="replace").decode() + describe_error(error)


class InvalidResultError(ValueError):
    """A plug-in returned a value of a wrong type or shape, or a number that is not finite."""


def to_number(value: Any, name: str) -> float:
    """Convert a number that a plug-in returned to a float; `name` names it in the error's text.

    A scalar or an array without dimensions of numpy, PyTorch or JAX is a number. A boolean, a text,
    a Decimal, a masked value, a time of numpy, and an integer that no float can hold are none: they
    raise an InvalidResultError.
    """
    if type(value) is float:
        return value
    plain = _plain(value)
    if not isinstance(plain, bool) and isinstance(plain, Real):
        with suppress(OverflowError):
            return float(plain)
    raise InvalidResultError(f"its {name} is {shorten(value)}, which is no number")


def to_integer(value: Any, name: str) -> int:
    """Convert an integer that a plug-in returned as `to_number` does; a float is none, also 3.0.

    A float holds no stamp exactly that is above 104 days in ns.
    """
    to_number(value, name)
    with suppress(TypeError):
        return operator.index(value)
    raise InvalidResultError(f"its {name} is {shorten(value)}, which is no integer")


def to_boolean(value: Any, name: str) -> bool:
    """Convert a truth value that a user's code returned as `to_number` does.

    The numbers 0 and 1 are truth values, too. A text is none: "False" would be true.
    """
    plain = _plain(value)
    if isinstance(plain, bool | Real) and plain in (0, 1):
        return bool(plain)
    raise InvalidResultError(f"its {name} is {shorten(value)}, which is no boolean")


def _plain(value: Any) -> Any:
    """Return the item of a scalar of numpy, PyTorch or JAX, and any other value as it is.

    Return None for a scalar whose item looks like a number but is none: the item of a masked value
    of numpy is 0, and that of a time is a count of its unit, such as ns.
    """
    plain = value.item() if getattr(value, "shape", None) == () else value
    kinds = (getattr(getattr(each, "dtype", None), "kind", "") for each in (value, plain))
    is_masked = value is not plain and bool(getattr(value, "mask", False))
    return None if is_masked or not {"m", "M"}.isdisjoint(kinds) else plain


def to_numbers(values: Any) -> NDArray[Any]:
    """Return the numbers that a user gave in an array or in nested lists as an array.

    Each of them is judged as by `to_number`. An array of numbers keeps its type.

    Raises:
        InvalidResultError: If one is no number, not finite or beyond `LARGEST`; the text has its
            place.
    """
    import numpy as np

    if type(values) is not np.ndarray or values.dtype.kind not in "iuf":
        for place, value in _leaves_of(values):
            to_number(value, _name_of(place))
    array = np.asarray(values)
    if array.dtype.kind not in "iuf":
        array = array.astype(float)
    fits = np.abs(array) <= LARGEST  # False for NaN
    if not fits.all():
        place = np.argwhere(~fits)[0].tolist()
        number = array[tuple(place)]
        why = f"beyond {LARGEST:g}" if np.isfinite(number) else "not finite"
        raise InvalidResultError(f"its {_name_of(place)} is {number:g}, {why}")
    return array


def to_arrays(value: Any) -> Any:
    """Return a value with arrays of numpy in place of PyTorch's tensors, also in maps and lists.

    A tensor may be on a GPU, have a gradient, or a type that numpy does not know, as bfloat16.
    """
    if isinstance(value, Mapping):
        return {key: to_arrays(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return (tuple if isinstance(value, tuple) else list)(map(to_arrays, value))
    if not hasattr(value, "detach"):
        return value
    tensor = value.detach().cpu()
    try:
        return tensor.numpy()
    except TypeError:
        return tensor.float().numpy()


def _name_of(place: list[int]) -> str:
    return f"value at {place}" if place else "value"


def _leaves_of(values: Any, place: tuple[int, ...] = ()) -> Iterator[tuple[list[int], Any]]:
    """Yield place and value of what may be no number in nested lists and arrays."""
    import numpy as np

    if isinstance(values, np.ma.MaskedArray):
        values = values.tolist()  # in which a masked value is None
    if isinstance(values, Sequence) and not isinstance(values, str | bytes):
        if {*map(type, values)} == {float}:  # the usual case, which must be fast
            return
        for number, each in enumerate(values):
            yield from _leaves_of(each, (*place, number))
    elif not hasattr(values, "__array__"):
        yield [*place], values
    elif (array := np.asarray(values)).dtype.kind not in "iuf":
        for inside, each in np.ndenumerate(array):
            yield [*place, *inside], each


def shorten(value: Any) -> str:
    """Describe a value in a short text: its type and, as far as it has one, its representation."""
    shown = ""
    with suppress(Exception):  # a user's __repr__ may raise, and so does that of a huge integer
        shown = to_one_line(re.sub(rf"{PREFIX}\w+\.", "", repr(value)))[:SHOWN_MAX]
    return f"{type(value).__name__} {shown}".strip()


def is_path(name: str) -> bool:
    """Check whether the name of a plug-in is the path of a file."""
    return name.endswith(".py") or "/" in name or "\\" in name


def _suggest_file(path: Path) -> str:
    """Return a suggestion of a file beside a missing one, to append to an error text; or "".

    It has the same name in other letters, or with another suffix, such as `.py.txt`.
    """

    def plain(name: str) -> str:
        return name.casefold().partition(".")[0].replace("-", "_").replace(" ", "_")

    with suppress(OSError):
        files = sorted(each.name for each in path.parent.iterdir() if each.is_file())
        near = [name for name in files if plain(name) == plain(path.name)]
        return f"; did you mean {near[0]}?" if near else ""
    return ""


def builder(kind: str, name: str, *, look: bool = True) -> Callable[..., Any]:
    """Return the function `build` of a plug-in, to `look` at it or to call it.

    Raise a BadInputError if there is none.
    """
    build = find(kind, name, look=look).builder
    if not callable(build):
        raise BadInputError(
            f"{one(kind)} {name!r} has no function build(); write one that returns the plug-in"
        )
    return build  # type: ignore[no-any-return]


def _shipped(kind: str) -> list[str]:
    if kind not in PACKAGES:
        raise BadInputError(unknown_name_text("kind of plug-in", kind, list(PACKAGES)))
    if not PACKAGES[kind]:
        return []
    modules = pkgutil.iter_modules(importlib.import_module(PACKAGES[kind]).__path__)
    return [module.name for module in modules if not module.name.startswith("_")]


def _module_of(path: Path) -> str | None:
    """Return the name of the module of cloudrc in a file; None for a file from elsewhere."""
    package = Path(__file__).parent
    if not path.is_relative_to(package):
        return None
    return ".".join(["cloudrc", *path.relative_to(package).with_suffix("").parts])


def _installed(kind: str) -> dict[str, EntryPoint]:
    return _entries(kind, tuple(sys.path))


def versions_of(top: str) -> list[str]:
    """Return names and versions of the packages that have installed a top-level package."""
    return [f"{name} {version(name)}" for name in sorted({*_distributions().get(top, ())})]


@cache
def _distributions() -> Mapping[str, list[str]]:
    return packages_distributions()


@cache  # the search takes milliseconds, which every flight of a sweep would pay
def _entries(kind: str, path: tuple[str, ...]) -> dict[str, EntryPoint]:
    """Return the entry points of a kind in the packages on `path`, Python's search path."""
    return {entry.name: entry for entry in entry_points(group=f"cloudrc.{kind}")}


def one(kind: str) -> str:
    """Return the word for one plug-in of a kind, such as "predictor"."""
    return "policy" if kind == "policies" else kind.removesuffix("s")


def _explain(error: BaseException) -> str:
    """Describe an exception in one line, without its type if it was raised to inform the user."""
    described = describe_error(error)
    if isinstance(error, ValueError | CloudrcError):
        return described.partition(": ")[2] or described
    return described
