# SPDX-License-Identifier: Apache-2.0

"""Share parsed files, checks and hashes among the experiments that one command plans.

Outside of `reuse_results` nothing is kept, because a user may edit a file between two commands of
a session.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

_Result = TypeVar("_Result")
_kept: list[dict[Hashable, Any]] = []
"""The results of the outermost `with reuse_results()`; empty outside of all."""


@contextmanager
def reuse_results() -> Iterator[None]:
    """Keep results inside the block, in which files are taken as unchanged."""
    if _kept:  # the outer block keeps them longer
        yield
        return
    _kept.append({})
    try:
        yield
    finally:
        _kept.pop()


def reuse(key: Hashable, compute: Callable[[], _Result]) -> _Result:
    """Return `compute()`, or its earlier result for an equal `key`, which must not be changed."""
    if not _kept:
        return compute()
    results = _kept[-1]
    if key not in results:
        results[key] = compute()
    result: _Result = results[key]
    return result
