# SPDX-License-Identifier: Apache-2.0

"""Read the metrics that a process shows in Prometheus' text format."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, TypeAlias


class Series(NamedTuple):
    """A time series."""

    name: str  # of the metric
    labels: frozenset[tuple[str, str]]  # names and values


Metrics: TypeAlias = Mapping[Series, float]
"""What a process shows: the value of each series."""


def read_metrics(text: str) -> dict[Series, float]:
    """Parse metrics; raise a ValueError for another format."""
    from prometheus_client.parser import text_string_to_metric_families

    return {
        Series(sample.name, frozenset(sample.labels.items())): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def total(metrics: Metrics, name: str, **labels: str) -> float:
    """Add up the series of a metric that have these labels; 0 without one."""
    wanted = labels.items()
    found = (series for series in metrics if series.name == name and wanted <= series.labels)
    return sum((metrics[series] for series in found), 0.0)
