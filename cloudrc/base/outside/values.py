# SPDX-License-Identifier: Apache-2.0

"""Numbers from outside: one type reads texts, objects and arrays, and says which are valid.

All doors read numbers with a `Quantity`, so they agree on what a number is: `1e3` is one, and
`1_000`, `0x5`, `nan`, `inf` and True are none. A number of NumPy, PyTorch or JAX is one; a masked
value, a time of NumPy and a Decimal are none.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import inf, isfinite
from numbers import Rational
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from numpy.typing import NDArray

SHOWN_MAX = 60
"""Largest length of a wrong value in a message [characters]."""
LARGEST = 1e30
"""Largest size of a number that users' code returns [any unit]. Metrics square numbers, and the
report's page stores some with single precision: a much larger number overflows there."""
FEW = 32
"""Up to this count, numbers in a list take less time than in an array [1]."""
HUGE = 1e18
"""Size from which on an error does not name a limit [any unit]."""
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?", re.ASCII | re.IGNORECASE)
_FLOAT_MAX = sys.float_info.max
_WHOLE = re.compile(r"[+-]?\d+", re.ASCII)


class InvalidValueError(ValueError):
    """What comes from outside cannot be used; the text says what it is, and what is valid."""


@dataclass(frozen=True)
class Quantity:
    """A number with a unit and a range.

    As the annotation of a key, it gives the range to pydantic.
    """

    unit: str = "1"
    ge: float = -inf  # smallest value [unit]
    le: float = inf  # largest value [unit]
    gt: float = -inf  # every value is larger [unit]
    whole: bool = False

    def of(self, value: Any, name: str = "") -> Any:
        """Convert a number of Python, NumPy, PyTorch or JAX to a float, or to an int if `whole`.

        `name` names the value in the error's text.
        """
        if type(value) is float and self.ge <= value <= self.le and value > self.gt:
            if not self.whole and -inf < value < inf:
                return value  # the usual case, which must be fast
        plain = plain_of(value)
        is_number = isinstance(plain, float | Rational) and not isinstance(plain, bool)
        return self._convert(plain if is_number else None, value, name)

    def read(self, text: str, name: str = "") -> Any:
        """Convert the text of a flag or of a cell to a float, or to an int if `whole`."""
        stripped = text.strip()
        number: float | None = None
        if _WHOLE.fullmatch(stripped) and len(stripped) < SHOWN_MAX:
            number = int(stripped)
        elif _NUMBER.fullmatch(stripped):
            number = float(stripped)
        return self._convert(number, text, name)

    def row(self, values: Any, count: int, name: str = "") -> tuple[float, ...]:
        """Convert `count` numbers in a row, such as those of a vector."""
        if type(values) is tuple and len(values) == count and {*map(type, values)} == {float}:
            if self.ge <= min(values) and max(values) <= self.le and isfinite(sum(values)):
                return values  # the usual case
        found = self.array(values, name)
        if found.shape != (count,):
            raise InvalidValueError(f"{_named(name, values)} not {count} numbers")
        return tuple(map(float, found.tolist()))

    def array(self, values: Any, name: str = "") -> NDArray[Any]:
        """Convert numbers in an array or in nested lists; an array of numbers keeps its type."""
        import numpy as np

        found: NDArray[Any] = self._numbers(values, (), name)
        try:
            found = np.asarray(found)
        except ValueError:  # rows of unequal lengths
            self.of(values, name)
        if found.size and not self._has_all(found):
            place = np.argwhere(~self._contains(found))[0].tolist()
            self.of(found[tuple(place)].item(), _at(place, name))
        return found

    def _numbers(self, values: Any, place: tuple[int, ...], name: str) -> Any:
        """Return an array, or nested lists with numbers alone."""
        import numpy as np

        if hasattr(values, "__array__") and not isinstance(values, np.ma.MaskedArray):
            values = np.asarray(values)
            if values.dtype.kind in "iuf":
                return values
        if isinstance(values, np.ndarray):
            values = values.tolist()  # a masked value is None
        if not isinstance(values, Sequence) or isinstance(values, str | bytes):
            number = self.of(values, _at(place, name))
            return values if type(values) is int else number  # a whole number stays one
        if {*map(type, values)} == {float}:  # the usual case, which must be fast
            return values
        return [self._numbers(each, (*place, n), name) for n, each in enumerate(values)]

    def has_floats(self, numbers: NDArray[Any]) -> bool:
        """Return whether an array has few floating-point numbers, in the range and finite.

        For large arrays and others, call `array`.
        """
        if not 0 < numbers.size <= FEW or numbers.dtype.kind != "f":
            return False
        few = numbers.ravel().tolist()
        # The least of several numbers may hide a NaN.
        return isfinite(sum(few)) and self._spans(min(few), max(few))

    def _has_all(self, numbers: NDArray[Any]) -> bool:
        """Return whether all numbers of an array are in the range and finite."""
        if self.has_floats(numbers):
            return True
        return self._spans(numbers.min().item(), numbers.max().item())

    def _spans(self, low: float, high: float) -> bool:
        """Return whether all numbers from `low` to `high` are in the range and finite."""
        return self.ge <= low and high <= self.le and low > self.gt and -inf < low and high < inf

    def _contains(self, numbers: Any) -> Any:
        """Return for each number of an array whether it is in the range and finite."""
        return (
            (numbers >= self.ge)
            & (numbers <= self.le)
            & (numbers > self.gt)
            & (numbers > -inf)
            & (numbers < inf)
        )

    def _convert(self, number: Any, given: Any, name: str) -> Any:
        """Return a number as a float or int; None is no number. `given` is the user's value."""
        fits = number is not None and self.ge <= number <= self.le and number > self.gt
        if fits and -inf < number < inf:
            if self.whole and isinstance(number, Rational) and number.denominator == 1:
                return number.numerator
            if not self.whole and abs(number) < _FLOAT_MAX:
                return float(number)
        raise InvalidValueError(f"{_named(name, given)} not {self}")

    def __str__(self) -> str:
        """Say which numbers are valid, such as "a number >= 0 and <= 1 [s]"."""
        limits = {">=": self.ge, ">": self.gt, "<=": self.le}
        form = "" if self.whole else ".15g"
        words = [f"{sign} {limit:{form}}" for sign, limit in limits.items() if abs(limit) < HUGE]
        kind = "a whole number" if self.whole else "a number" if words else "a finite number"
        return f"{kind} {' and '.join(words)}".rstrip() + f" [{self.unit}]" * (self.unit != "1")

    # Pydantic accepts a class with these two members in place of the ranges of annotated_types,
    # whose import takes longer than that of the whole link.
    @property
    def __is_annotated_types_grouped_metadata__(self) -> Literal[True]:
        return True

    def __iter__(self) -> Iterator[Any]:
        import annotated_types

        for name in ("ge", "gt", "le"):
            if abs(limit := getattr(self, name)) < inf:
                yield getattr(annotated_types, name.capitalize())(limit)


ANY = Quantity()
"""Any finite number."""
RESULT = Quantity(ge=-LARGEST, le=LARGEST)
"""A number that users' code returns."""
WHOLE = Quantity(ge=-(2**63), le=2**63 - 1, whole=True)
"""Any whole number that 64 bits hold."""


def to_boolean(value: Any, name: str = "") -> bool:
    """Convert a truth value of Python or NumPy, or 0 or 1; a text is none: "False" is true."""
    plain = plain_of(value)
    if isinstance(plain, bool | float | Rational) and plain in (0, 1):
        return bool(plain)
    raise InvalidValueError(f"{_named(name, value)} not true or false")


def plain_of(value: Any) -> Any:
    """Return the item of a scalar of NumPy, PyTorch or JAX, and any other value as it is.

    Return None for a scalar whose item looks like a number but is none: the item of a masked value
    of NumPy is 0, and that of a time is a count of its unit, such as ns.
    """
    plain = value.item() if getattr(value, "shape", None) == () else value
    kinds = (getattr(getattr(each, "dtype", None), "kind", "") for each in (value, plain))
    is_masked = value is not plain and bool(getattr(value, "mask", False))
    return None if is_masked or not {"m", "M"}.isdisjoint(kinds) else plain


def to_plain(value: Any, name: str = "") -> Any:
    """Convert what a program gives in place of a document to texts, numbers, lists and mappings.

    Raises:
        InvalidValueError: If a value is of another kind, or a number that is not finite. Its text
            has the key, below `name`.
    """
    if value is None or isinstance(value, str):
        return value
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, Mapping):
        above = f"{name}." if name else ""
        return {str(key): to_plain(each, f"{above}{key}") for key, each in value.items()}
    if getattr(value, "shape", ()) != ():
        value = ANY.array(value, name).tolist()
    if isinstance(value, list | tuple):
        return [to_plain(each, f"{name}.{n}") for n, each in enumerate(value)]
    plain = plain_of(value)
    if isinstance(plain, bool):
        return plain
    is_whole = isinstance(plain, Rational) and plain.denominator == 1
    return (WHOLE if is_whole else ANY).of(value, name)


def to_arrays(value: Any) -> Any:
    """Return a value with arrays of NumPy in place of PyTorch's tensors, also in maps and lists.

    A tensor may be on a GPU, have a gradient, or a type that NumPy does not know, as bfloat16.
    """
    if isinstance(value, dict):
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


def _named(name: str, value: Any) -> str:
    """Begin a sentence that ends with what the value is not."""
    return f"its {name} is {shorten(value)}," if name else f"{shorten(value)} is"


def _at(place: Sequence[int], name: str) -> str:
    return f"{name or 'value'} at {[*place]}" if place else name


def shorten(value: Any) -> str:
    """Describe a value in a short line: its representation, and the type of what is not plain."""
    is_huge = type(value) is int and value.bit_length() > 1000  # Python writes no such number
    shown = "" if is_huge else " ".join(repr(value)[: 4 * SHOWN_MAX].split())[:SHOWN_MAX]
    is_plain = value is None or type(value) in (bool, int, float, str)
    return shown if is_plain and shown else f"{type(value).__name__} {shown}".strip()
