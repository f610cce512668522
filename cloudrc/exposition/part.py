"""What the parts of a process's metrics have in common: handlers of records, readings for a scrape.

A handler runs on the loop's thread and has one microsecond: it keeps the newest record, counts, and
leaves everything else to `read`, which runs on the thread that is scraped.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from math import isnan
from typing import Any, Protocol, TypeAlias

from cloudrc.exposition.histogram import Histogram
from cloudrc.exposition.labels import AXES, Labels
from cloudrc.messages import Vector

Handlers: TypeAlias = Mapping[type, Callable[[Any], None]]
Readings: TypeAlias = dict[str, "dict[Labels, float] | Histogram"]
"""By metric: a value for each tuple of label values, or a histogram, which has no labels."""


class Part(Protocol):
    """Some of the metrics of one process."""

    def handlers(self) -> Handlers:
        """Which records it wants to see; no two parts of a process want the same."""

    def read(self) -> Readings:
        """Say all that is known now; what is not known is absent."""


def plain(value: float) -> dict[Labels, float]:
    """A metric without labels, of one `value` [base unit of the metric]."""
    return {(): value}


def known(value: float) -> dict[Labels, float]:
    """The same; absent if `value` [base unit of the metric] is NaN."""
    return {} if isnan(value) else {(): value}


def per_axis(vector: Vector) -> dict[Labels, float]:
    """A metric with the label axis; absent where `vector` [base unit of the metric] is NaN."""
    values = zip(AXES, vector, strict=True)
    return {(axis,): value for axis, value in values if not isnan(value)}


def by(counts: Mapping[str, float]) -> dict[Labels, float]:
    """A metric with one label."""
    return {(name,): count for name, count in counts.items()}


def chosen(names: Iterable[str], counts: Mapping[str, float]) -> dict[str, float]:
    """The counts of these names, 0 where nothing was counted."""
    return {name: counts.get(name, 0) for name in names}
