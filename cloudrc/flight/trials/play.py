# SPDX-License-Identifier: Apache-2.0

"""Play trials in several processes; each gives a row, and only those without one are played."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable
from operator import methodcaller
from typing import Protocol

from cloudrc.base import source
from cloudrc.base.errors import CloudrcError, InvalidRunError
from cloudrc.flight.trials.rows import Row, Rows
from cloudrc.flight.trials.workers import map_in_order, take_each


class Trial(Protocol):
    """A flight or an episode, under one condition and with one seed."""

    @property
    def key(self) -> str:
        """Name of its row; equal keys mean equal rows."""

    def play(self) -> Row:
        """Play it; return its row."""


def run(
    trials: Iterable[Trial],
    rows: Rows,
    jobs: int,
    see: Callable[[Row], None] = lambda row: None,
    *,
    in_order: bool = True,
) -> CloudrcError | None:
    """Play the trials without a row in `jobs` processes, and add their rows.

    Call `see` with each new row, in the order of the trials or, with `in_order` False, once it is
    ready. Return why the work ended early, or None.
    """
    missing = [each for each in trials if each.key not in rows.kept]
    return keep(map_in_order(methodcaller("play"), missing, jobs, in_order=in_order), rows, see)


def keep(
    played: Generator[Row], rows: Rows, see: Callable[[Row], None] = lambda row: None
) -> CloudrcError | None:
    """Add rows as they come; return why they ended early, or None."""

    def take(row: Row) -> None:
        if row["code"] != source.code_hash():
            raise InvalidRunError("the code of cloudrc has changed meanwhile; begin again")
        rows.add(row)
        see(row)

    return take_each(played, take)
