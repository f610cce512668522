# SPDX-License-Identifier: Apache-2.0

"""Name the code that a flight runs: one hash of all source files that can change its numbers.

Flights of different code must not be mixed in one table, and `__version__` is equal for all commits
between two releases.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from hashlib import sha256
from importlib.resources import files
from importlib.resources.abc import Traversable

SUFFIXES = (".py", ".c", ".h", ".xml", ".yaml")
"""Endings of source files. Files that are built from them, such as *.pyc and *.so, do not count."""
_NOT_FLOWN = {
    "": "_chart doors cluster",
    # Of studies, what asks for rows, orders and shows them; the rest makes rows.
    "studies/": "bench capacity capacity_text check compare compare_text compute cpu_limit "
    "exercise figure identify margin place pods search stability sweep",
    "studies/eval/": "page provenance",
    "studies/policy/": "serve",
    "studies/rank/": "entry page score",
    "studies/reproduce/": "figure statements table",
    # Of results, what shows a flight to people, or finds it.
    "results/": "exposition timeline under_way",
    "results/report/": "figures fleet_page page polar replay robot_picture scene summary",
}
NOT_FLOWN = frozenset(
    f"{wing}{name}" for wing, names in _NOT_FLOWN.items() for name in names.split()
)
"""Folders and modules of the package from which nothing runs that makes a row of a sweep, of an
evaluation or of a ranking: a change in them ends none that is under way."""


@cache
def code_hash() -> str:
    """Return the hash of the installed sources: 16 hexadecimal digits; takes some milliseconds."""
    total = sha256()
    for name, content in sorted(_sources(files("cloudrc"))):
        total.update(f"{name}\n{sha256(content).hexdigest()}\n".encode())
    return total.hexdigest()[:16]


def _sources(folder: Traversable, above: str = "") -> Iterator[tuple[str, bytes]]:
    """Yield path and content of each source file, also if the package is in a zip file."""
    for entry in folder.iterdir():
        name = f"{above}{entry.name}"
        is_hidden = entry.name.startswith(".")  # such as an editor's copy
        if is_hidden or name.removesuffix(".py") in NOT_FLOWN:
            continue
        if entry.is_dir():
            yield from _sources(entry, f"{name}/")
        elif name.endswith(SUFFIXES):
            yield name, _read(entry)


def _read(file: Traversable) -> bytes:
    try:
        return file.read_bytes()
    except OSError:  # a flight cannot run this file either: it is other code
        return b"unreadable"
