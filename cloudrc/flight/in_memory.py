# SPDX-License-Identifier: Apache-2.0

"""Fly one experiment in virtual time without writing files; return its verdict and metrics."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, TypeAlias

from cloudrc.base import plugins
from cloudrc.base.errors import describe_error, machine_error
from cloudrc.base.outside import code
from cloudrc.config.link_schedule import link_start
from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.flight.assembly.world import step_code
from cloudrc.flight.virtual.flight import fly_virtual, virtual_notes
from cloudrc.results.metrics.measure import SHIPPED, find
from cloudrc.results.record.columns import Recording, RecordStore
from cloudrc.results.report.document import Assessment, Run
from cloudrc.results.report.write import assess

ERROR = "error"
"""Verdict of a flight that raised an exception, and code of its only failure."""
Row: TypeAlias = dict[str, Any]
"""Result of a flight: `verdict`; `failures` (codes, `timed_out` first, then the earliest); `text`
(the first failure, and why a metric has no value); `numbers` (metric -> value); `link_start`, where
the schedule of the link begins [s]; `records_sha256`;
`physics_steps`, the language of the physics steps and a hash of their machine code; and, if a
plug-in failed, `traceback`. A row of a sweep also has `key`, `point`, `seed` and `code`, a hash of
the sources."""


def fly_point(experiment: ResolvedExperiment) -> Row:
    """Fly an experiment in virtual time and measure it; an exception becomes the verdict ERROR.

    Raises:
        MissingPrerequisiteError: If the machine failed, not the flight. It must be flown again.
    """
    return or_error(partial(measure, experiment))


def or_error(fly: Callable[[], Row]) -> Row:
    """Return the row of a flight that `fly` makes; an exception becomes the verdict ERROR."""
    try:
        return fly()
    except code.FAILURES as error:  # one point that cannot fly must not stop the others
        none: Row = {"numbers": {}, "records_sha256": "", "physics_steps": ""}
        return {"verdict": ERROR, "failures": [ERROR], "text": explain(error), **none}


def explain(error: BaseException) -> str:
    """Say why a flight has raised an exception; raise it if the machine failed, not the flight."""
    if failure := machine_error(error):
        raise failure from error
    code.check_failure(error, "the flight")
    return f"{code.place_of(error)}{describe_error(error)}"


def measure(experiment: ResolvedExperiment) -> Row:
    """Fly an experiment in virtual time and measure it; nobody will see its pictures again."""
    if (camera := experiment.camera) is not None:
        unkept = camera.model_copy(update={"keep": False})
        experiment = experiment.model_copy(update={"camera": unkept})
    return row_of(fly_in_memory(experiment), experiment)


def row_of(found: Assessment, experiment: ResolvedExperiment) -> Row:
    """Return the row of a flight in virtual time."""
    failures = found.verdict.failures
    return {
        "verdict": found.verdict.outcome,
        "failures": [failure.code for failure in failures],
        "text": "; ".join([*(failure.text for failure in failures[:1]), *found.metric_notes]),
        "numbers": {name: number.value for name, number in found.numbers.items()},
        "link_start": link_start(experiment),
        "records_sha256": found.records_sha256,
        "physics_steps": step_code(experiment),
        **({"traceback": found.traceback} if found.traceback else {}),
    }


def counts(row: Row) -> bool:
    """Return whether the metrics of a flight are valid results of its experiment.

    They are invalid if the flight did not end, if a plug-in failed in too many periods, or if the
    onboard controller failed.
    """
    failed = {"plugin_failed", "onboard_failed"}.intersection(row["failures"])
    return row["verdict"] in ("success", "failure") and not failed


def units(own: Iterable[str]) -> dict[str, str]:
    """Return name -> unit of all metrics that are shipped or installed, and of those in `own`.

    `own` contains names of metrics and paths of files with a metric.
    """
    names = (*SHIPPED, *plugins.names("metrics"), *own)
    return {metric.name: metric.unit for metric in map(find, names)}


def fly_in_memory(experiment: ResolvedExperiment) -> Assessment:
    """Fly an experiment in virtual time, and measure and judge it, without any file."""
    store = RecordStore()
    fly_virtual(experiment, store.add)
    run = Run("virtual", "virtual", notes=virtual_notes(experiment))
    return assess(Recording(records=store), experiment, run, experiment.report.metrics)
