"""Compute the metrics of a recorded flight; each metric is one number with a unit.

`measure` finds and computes metrics; the metrics of cloudrc are rows of tables in `flight`,
`control`, `link` and `mission`. `definitions` has the quantities that live metrics, console and
report share. docs/plugins.md explains how to add your own metrics.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cloudrc.metrics.measure import (
        METRIC_NOTE,
        SHIPPED,
        Flight,
        Metric,
        Number,
        check,
        find,
        measure_all,
        name_of,
        not_measured,
        scale,
    )

__all__ = [
    "METRIC_NOTE",
    "SHIPPED",
    "Flight",
    "Metric",
    "Number",
    "check",
    "find",
    "measure_all",
    "name_of",
    "not_measured",
    "scale",
]


def __getattr__(name: str) -> Any:
    # Lazily, because `definitions` needs neither recordings nor pydantic.
    if name in __all__:
        from cloudrc.metrics import measure

        return getattr(measure, name)
    raise AttributeError(f"module 'cloudrc.metrics' has no attribute {name!r}")
