# SPDX-License-Identifier: Apache-2.0

"""Know the holes of a recording: the times in which its messages are lost.

The recorder notes them, the reader finds the lost end of a torn file, and the metadata of a copy
keep them. What is computed over time, such as an age or a loss, is computed outside of the holes,
or not at all.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple

from cloudrc.base.text import list_some

HOLES = "holes"
"""Metadata key: start and end of each hole as JSON [ns]."""
END_NS = 1 << 62
"""End of a hole behind which there is no message [ns]."""


class Hole(NamedTuple):
    """A time in which messages of a recording are lost, by the recording's log times."""

    begin_ns: int  # last message before the hole [ns]; 0: none
    end_ns: int  # first message behind the hole [ns]; END_NS: none

    def meets(self, first_ns: float, last_ns: float) -> bool:
        """Return whether messages from `first_ns` to `last_ns` [ns] may be lost."""
        return self.begin_ns < last_ns and first_ns < self.end_ns

    def describe(self, seconds: Callable[[int], float]) -> str:
        """Describe the hole in words; `seconds` converts a log time [ns] to a time [s]."""
        begin, end = seconds(self.begin_ns), seconds(self.end_ns)
        if self == SOMEWHERE:
            return "messages lost, nobody knows when"
        if self.end_ns >= END_NS:
            return f"all lost from {begin:.2f} s on"
        return f"{end - begin:.2f} s lost at {begin:.2f} s"


SOMEWHERE = Hole(0, END_NS)
"""In place of the holes if nobody knows when the lost messages were."""


def describe(holes: Iterable[Hole], seconds: Callable[[int], float]) -> str:
    """Describe the first holes in words, and count the others; "" without a hole."""
    return list_some([hole.describe(seconds) for hole in sorted(set(holes))])


def goes_on(holes: Iterable[Hole]) -> bool:
    """Return whether the recording goes on behind one of its holes."""
    return any(hole.end_ns < END_NS or hole == SOMEWHERE for hole in holes)


def unasked(holes: Iterable[Hole], kills: int) -> list[Hole]:
    """Return the holes but for the first `kills` ones before a message: faults made them."""
    ordered = sorted(set(holes))
    made = [hole for hole in ordered if hole.end_ns < END_NS][:kills]
    return [hole for hole in ordered if hole not in made]


def union(holes: Iterable[Hole]) -> tuple[Hole, ...]:
    """Return holes of the same times, in their order and without an overlap."""
    apart = list[Hole]()
    for hole in sorted(set(holes)):
        if apart and hole.begin_ns < apart[-1].end_ns:
            begin_ns, end_ns = apart.pop()
            apart.append(Hole(begin_ns, max(end_ns, hole.end_ns)))
        else:
            apart.append(hole)
    return tuple(apart)


def to_metadata(holes: Iterable[Hole]) -> dict[str, str]:
    """Return the holes as an entry of a file's metadata."""
    return {HOLES: json.dumps(sorted(set(holes)))}


def of_metadata(metadata: Mapping[str, str]) -> tuple[Hole, ...] | None:
    """Return the holes that a file's metadata name; None if they say nothing about holes."""
    return tuple(Hole(*pair) for pair in json.loads(metadata[HOLES])) if HOLES in metadata else None
