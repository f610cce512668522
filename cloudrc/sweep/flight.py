"""Fly one experiment in virtual time without any file, and keep its verdict and its numbers."""

from __future__ import annotations

from dataclasses import dataclass, field

from cloudrc import assembly
from cloudrc.config.load import ResolvedExperiment
from cloudrc.errors import describe_error
from cloudrc.metrics import Number
from cloudrc.record.columns import Recording
from cloudrc.record.hash import RecordHash
from cloudrc.records import Record
from cloudrc.report.document import Run
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
    except Exception as error:  # one point that cannot fly must not stop the others
        return Outcome(ERROR, (ERROR,), text=describe_error(error))


def _fly(experiment: ResolvedExperiment) -> Outcome:
    of_world, of_cloud, digest = list[Record](), list[Record](), RecordHash()

    def sink(from_world: list[Record], from_cloud: list[Record]) -> None:
        of_world.extend(from_world)
        of_cloud.extend(from_cloud)
        digest.update(from_cloud)
        digest.update(from_world)

    _, cloud, flight = assembly.assemble(experiment)
    limit_ns = round(assembly.flight_limit(experiment) * 1e9)
    flight.fly(lambda: cloud.mission_over, limit_ns, sink)
    run = Run("virtual", "virtual", digest.hexdigest())
    recording = Recording.from_records(of_world, of_cloud)
    found = assess(recording, experiment, run, experiment.report.metrics)
    failures = found.verdict.failures
    return Outcome(
        found.verdict.outcome,
        tuple(failure.code for failure in failures),
        found.numbers,
        digest.hexdigest(),
        failures[0].text if failures else "",
    )
