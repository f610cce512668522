# SPDX-License-Identifier: Apache-2.0

"""The error about a value from outside: its place, the value, and what is valid."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager

from cloudrc.base.errors import BadInputError
from cloudrc.base.outside.values import InvalidValueError
from cloudrc.base.text import unknown_name_text

_UNREADABLE = (
    *(OSError, EOFError, ValueError, LookupError, TypeError, AttributeError, RecursionError),
)
"""What reading a file of an unknown content may raise."""


@contextmanager
def naming(place: str, wanted: str = "") -> Iterator[None]:
    """Turn an InvalidValueError of the block into a BadInputError that names its place.

    `place` is a flag, a key or an argument, `wanted` says in words what it is.
    """
    try:
        yield
    except InvalidValueError as error:
        hint = f"; give {wanted}" if wanted else ""
        raise BadInputError(f"{place}: {error}{hint}") from None


@contextmanager
def reading(place: object, text: str) -> Iterator[None]:
    """Turn an error of the block, which reads a file of ours, into a BadInputError about its place.

    Another program has cut or changed the file, or an early version of cloudrc has written it.
    """
    try:
        yield
    except _UNREADABLE as error:
        raise BadInputError(f"{place}: {text} ({error})") from error


def check_names(what: str, names: Iterable[str], known: Iterable[str], place: str = "") -> None:
    """Raise a BadInputError if one of the `names` is none of the `known`; it suggests the nearest.

    `what` says what the names are those of, `place` precedes the error's text, as "--flag: ".
    """
    there = [*known]
    for name in names:
        if name not in there:
            raise BadInputError(f"{place}{unknown_name_text(what, name, there)}")
