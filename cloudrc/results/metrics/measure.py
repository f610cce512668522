# SPDX-License-Identifier: Apache-2.0

"""Find metrics by their names or files, and compute all metrics of a recorded flight."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from cloudrc.base import plugins
from cloudrc.base.errors import describe_error
from cloudrc.base.outside import code
from cloudrc.base.outside.patience import telling_if_slow
from cloudrc.base.outside.refusal import check_names, naming
from cloudrc.base.outside.values import RESULT, InvalidValueError
from cloudrc.results.metrics import (
    budget,
    camera,
    control,
    follow,
    link,
    mission,
    perception,
    response,
)
from cloudrc.results.metrics.flight import SHIPPED, Flight, Metric, add_quantities
from cloudrc.results.record.holes import goes_on

# The imported modules add the metrics of cloudrc to SHIPPED.
add_quantities()
__all__ = ["SHIPPED", "Flight", "Metric"]
__all__ += ["budget", "camera", "control", "follow", "link", "mission", "perception"]
__all__ += ["response"]

METRIC_NOTE = "metric "
"""Beginning of a note about a metric, by which readers of a stored report know it."""


IN_SPITE_OF_HOLES = {
    "duration",
    "waypoints_reached",
    "rtt_mean",
    "rtt_p95",
    "delay_sample_mean",
    "uplink_delay_mean",
    "downlink_delay_mean",
    "late_uplink",
    "late_downlink",
    "age_of_information_mean",
    "seen_to_acted",
    "frame_psnr",
    "prediction_error_rms",
    "estimate_error_rms",
    "delay_estimate_error_rms",
    "tracking_rms_measured",
    "tracking_rms_estimated",
    "tracking_error_p95",
    "overshoot_mean",
    "rise_time_mean",
    "settling_time_mean",
    "iae_mean",
    "ise_mean",
    "squared_command_integral_mean",
    "world_lateness_p99",
    "cloud_lateness_p99",
    "world_slip",
    "real_time_factor",
    *(f"{budget.NUMBER}{name}" for name in budget.NAMES),
}
"""Metrics of a flight with lost messages: means over the rows or steps that are left, and what the
rest of the recording proves. All other metrics would be wrong: they compute over time, count, or
look for an extreme."""


@dataclass(frozen=True, slots=True)
class Number:
    """The value of a metric with its unit."""

    value: float  # finite
    unit: str  # SI unit as text; "1" for counts and shares
    meaning: str  # one sentence


def scale(unit: str, largest: float) -> tuple[float, str]:
    """Return a factor and a new unit for small values: 1000 and "mm" if the unit is "m".

    `largest` [`unit`] is the largest of the values. If it is not small, the factor is 1.
    """
    if 0 < largest < {"m": 0.1, "s": 1.0}.get(unit, 0.0):
        return 1e3, f"m{unit}"
    return 1.0, "" if unit == "1" else unit


def find(choice: str, *, look: bool = False) -> Metric:
    """Find a metric by its name, or by the path of a Python file, which is executed.

    With `look`, the caller does not measure.
    """
    if choice in SHIPPED:
        return SHIPPED[choice]
    known = [*SHIPPED, *plugins.names("metrics")]
    name, is_path = name_of(choice), plugins.is_path(choice)
    if not is_path:
        check_names("metric", [choice], sorted(known))
    with naming(f"metric {choice!r}"):
        if is_path and name in known:
            raise InvalidValueError(f"{name} is a metric already; rename the file")
        found = plugins.find("metrics", choice, look=look)
        unit, measure = found.get("UNIT"), found.get("measure")
        if not isinstance(unit, str) or not callable(measure):
            raise InvalidValueError("needs a text UNIT and a function measure(flight); write both")
    return Metric(name, unit, found.doc, measure)


def name_of(choice: str) -> str:
    """Return a metric's name in report.json; if `choice` is a path, the file name without `.py`."""
    return Path(choice).stem if plugins.is_path(choice) else choice


def check(own: Iterable[str]) -> None:
    """Check the user's metrics before the flight: each can be used, and has a name of its own.

    `own` lists their names or file paths.
    """
    for name, count in Counter(find(choice, look=True).name for choice in own).items():
        with naming(f"metric {name}"):
            if count > 1:
                raise InvalidValueError(f"{count} metrics have this name; rename a file")


def not_measured(named: Iterable[str], own: Iterable[str]) -> list[str]:
    """Return a note for each metric of the experiment that is a file and was not measured.

    `named` are the experiment's metrics, `own` those that the user names with --metric. A file may
    be code from somebody else, so it is executed only if the user names it.
    """
    names = set(map(name_of, own))
    return [
        f"{METRIC_NOTE}{name_of(choice)} is not measured: name its file with --metric"
        for choice in named
        if plugins.is_path(choice) and name_of(choice) not in names
    ]


class Measured(NamedTuple):
    """The numbers of a flight."""

    numbers: dict[str, Number]  # known numbers by name, sorted
    notes: list[str]  # one for each metric that failed
    traceback: str  # of the first one that raised, "" if none did


def measure_all(flight: Flight, own: Iterable[str] = ()) -> Measured:
    """Compute the metrics of cloudrc, of installed packages and of the user.

    `own` lists the user's metrics by name or file path. A failure of a user's metric affects only
    this metric. If messages of the flight are lost, compute only `IN_SPITE_OF_HOLES`.
    """
    numbers: dict[str, Number] = {}
    choices, notes = _choose(flight, {*SHIPPED, *plugins.names("metrics"), *own})
    traceback = ""
    for choice in sorted(choices, key=name_of):
        name = name_of(choice)
        try:
            metric = find(choice)
            if choice in SHIPPED:
                value = metric.measure(flight)
            else:
                # A user's metric may change what it is given: it gets tables of its own.
                own_flight = replace(flight, copies=True)
                with code.apart(), telling_if_slow(f"metric {choice} is still being computed"):
                    value = metric.measure(own_flight)
            if value is None:
                continue
            number = RESULT.of(value, "value")
            numbers[name] = Number(number, metric.unit, metric.meaning)
        except code.FAILURES as error:
            code.check_failure(error, f"{METRIC_NOTE}{name}")
            why = f"{code.place_of(error)}{describe_error(error)}"
            notes.append(f"{METRIC_NOTE}{name} failed: {why}")
            traceback = traceback or code.stack_of(error)
    return Measured(numbers, notes, traceback)


def _choose(flight: Flight, choices: set[str]) -> tuple[set[str], list[str]]:
    """Leave out the metrics that lost messages would make wrong; also return notes about them."""
    if not flight.holes:
        return choices, []
    ends = flight.ending is not None or not goes_on(flight.holes)
    left = choices & IN_SPITE_OF_HOLES if ends else set[str]()
    others = sorted(name_of(choice) for choice in choices - left if choice not in SHIPPED)
    notes = [f"{METRIC_NOTE}{name} is not measured: messages are lost in flight" for name in others]
    about = "All numbers that this can make wrong"
    about = about if ends else "The end of the flight is lost, too: all numbers"
    return left, [f"{about} are left out, because messages are lost in flight.", *notes]
