"""Fly one experiment in virtual time without any file, and keep its verdict and its numbers."""

from __future__ import annotations

from dataclasses import dataclass, field

from cloudrc import assembly
from cloudrc.config.load import ResolvedExperiment
from cloudrc.errors import describe_error
from cloudrc.metrics import Number
from cloudrc.record.columns import RecordStore
from cloudrc.records import Record
from cloudrc.report.document import Assessment, Run
from cloudrc.report.write import assess

ERROR = "error"
"""Verdict of a flight that raised an exception, and code of its only failure."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What remains of a flight."""

    verdict: str  # as in report.json, or ERROR
    failures: tuple[str, ...] = ()  # codes, the earliest failure first
    numbers: dict[str, Number] = field(default_factory=dict)  # metric -> value
    records_sha256: str = ""  # equal to that of `cloudrc run --mode virtual`; "" after an error
    text: str = ""  # the first failure in words


def fly_point(experiment: ResolvedExperiment) -> Outcome:
    """Fly an experiment in virtual time and measure it; an exception becomes the verdict ERROR."""
    try:
        return _fly(experiment)
    except (Exception, SystemExit) as error:  # one point that cannot fly must not stop the others
        return Outcome(ERROR, (ERROR,), text=describe_error(error))


def _fly(experiment: ResolvedExperiment) -> Outcome:
    found = fly_in_memory(experiment)
    failures = found.verdict.failures
    return Outcome(
        found.verdict.outcome,
        tuple(failure.code for failure in failures),
        found.numbers,
        found.run.records_sha256 or "",
        failures[0].text if failures else "",
    )


def fly_in_memory(experiment: ResolvedExperiment) -> Assessment:
    """Fly an experiment in virtual time, and measure and judge it, without any file."""
    store = RecordStore()
    _, cloud, flight = assembly.assemble(experiment)
    limit_ns = round(assembly.flight_limit(experiment) * 1e9)

    def sink(from_world: list[Record], from_cloud: list[Record]) -> None:
        store.add(from_world, flight.on_world_clock(from_cloud))

    flight.fly(lambda: cloud.mission_over, limit_ns, sink)
    notes = assembly.virtual_notes(experiment)
    run = Run("virtual", "virtual", store.hexdigest(), notes=notes)
    return assess(store.recording(), experiment, run, experiment.report.metrics)
