"""What one Prometheus metric is: its name, type, meaning, labels, and who exposes it."""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from types import MappingProxyType
from typing import NamedTuple

from cloudrc.exposition.labels import DELAY_BUCKETS, Labels


class Kind(Enum):
    """What Prometheus calls the type of a metric."""

    COUNTER = "counter"
    GAUGE = "gauge"
    HISTOGRAM = "histogram"


class Metric(NamedTuple):
    """One metric.

    Attributes:
        name: As it is scraped; a histogram adds `_bucket`, `_sum` and `_count`.
        kind: Its type.
        meaning: One sentence or two: the HELP text.
        roles: Which processes expose it.
        labels: Name -> all values that it may have.
        buckets: Upper bounds of a histogram, rising, in the metric's unit.
    """

    name: str
    kind: Kind
    meaning: str
    roles: tuple[str, ...]
    labels: Mapping[str, Labels] = MappingProxyType({})
    buckets: tuple[float, ...] = ()


def counter(name: str, meaning: str, roles: tuple[str, ...], **labels: Labels) -> Metric:
    """What only rises."""
    return Metric(name, Kind.COUNTER, meaning, roles, labels)


def gauge(name: str, meaning: str, roles: tuple[str, ...], **labels: Labels) -> Metric:
    """What is so now."""
    return Metric(name, Kind.GAUGE, meaning, roles, labels)


def delay(name: str, meaning: str, roles: tuple[str, ...]) -> Metric:
    """How often a delay was how long."""
    return Metric(name, Kind.HISTOGRAM, meaning, roles, buckets=DELAY_BUCKETS)


def numbered(names: Labels) -> str:
    """Say which number stands for which state."""
    return ", ".join(f"{number} {name}" for number, name in enumerate(names))
