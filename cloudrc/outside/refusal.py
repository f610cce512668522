"""The error about a value from outside: its place, the value, and what is valid."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from cloudrc.errors import BadInputError
from cloudrc.outside.values import InvalidValueError


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
