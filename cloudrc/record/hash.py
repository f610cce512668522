"""Compute one SHA-256 over all records of a run, to compare runs.

A record is hashed as little-endian bytes, equal in every process. They contain in this order:

- the length and the name of the record's type;
- the numbers: integers with 64 bits, floats as IEEE 754 doubles, truth values with one byte;
- the vectors;
- the strings as UTF-8, each after its 32-bit length.

Within each group the order is that of the record's fields. A field that holds another record is
replaced by the fields of that record.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Callable, Iterable, Iterator
from enum import IntEnum
from functools import cache
from itertools import chain
from typing import Any, TypeAlias, get_args, get_origin, get_type_hints

from cloudrc.record.topics import values_getter
from cloudrc.records import Record

_Pack: TypeAlias = Callable[[Any], bytes]
_CODES = {int: "q", float: "d", bool: "?", str: "s"}


class RecordHash:
    """SHA-256 over records in their order, no matter how many records each `update` gets."""

    def __init__(self) -> None:
        self._sha256 = hashlib.sha256()

    def update(self, records: Iterable[Record]) -> None:
        """Add records to the hash, oldest first."""
        # mypy does not know that these classes are hashable.
        packed = [_packer(type(record))(record) for record in records]  # type: ignore[arg-type]
        self._sha256.update(b"".join(packed))

    def hexdigest(self) -> str:
        """Return the hash of all records so far, as 64 hexadecimal digits."""
        return self._sha256.hexdigest()


def messages_sha256(messages: Iterable[tuple[str, int, bytes]]) -> str:
    """Hash topic, log time [ns] and CDR bytes of a file's messages, in the order of the file.

    Real-time runs use this hash, because their records are not kept in memory.
    """
    sha256 = hashlib.sha256()
    for message in messages:
        add_message(sha256, *message)
    return sha256.hexdigest()


def add_message(sha256: hashlib._Hash, topic: str, log_time_ns: int, data: bytes) -> None:
    """Add one message to the hash of `messages_sha256`."""
    sha256.update(b"%s %d %d " % (topic.encode(), log_time_ns, len(data)))
    sha256.update(data)


@cache
def _packer(cls: type) -> _Pack:
    leaves = list(_leaves(cls, ""))
    numbers = values_getter([path for path, code in leaves if len(code) == 1 and code != "s"])
    vectors = values_getter([path for path, code in leaves if len(code) > 1])
    strings = values_getter([path for path, code in leaves if code == "s"])
    codes = sorted((code for _, code in leaves if code != "s"), key=lambda code: len(code) > 1)
    name = cls.__name__.encode()
    size, pack = len(name), struct.Struct(f"<B{len(name)}s" + "".join(codes)).pack

    def packed(record: Any) -> bytes:
        fixed = pack(size, name, *numbers(record), *chain.from_iterable(vectors(record)))
        return fixed + b"".join(map(_packed_string, strings(record)))

    return packed


def _leaves(cls: type, prefix: str) -> Iterator[tuple[str, str]]:
    """Yield the dotted path and the `struct` code of each plain value of a record."""
    for name, kind in get_type_hints(cls).items():
        path = prefix + name
        if hasattr(kind, "_fields"):
            yield from _leaves(kind, f"{path}.")
        elif get_origin(kind) is tuple:
            yield path, "d" * len(get_args(kind))
        else:
            yield path, "q" if issubclass(kind, IntEnum) else _CODES[kind]


def _packed_string(text: str) -> bytes:
    data = text.encode("utf-8", "surrogatepass")
    return len(data).to_bytes(4, "little") + data
