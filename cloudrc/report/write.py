"""Write the report of a run: report.json, environment.json, report.html and figures."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cloudrc.config.load import ResolvedExperiment
from cloudrc.errors import BadInputError, MissingPrerequisiteError, describe_error
from cloudrc.files import write_atomically
from cloudrc.geometry.scene import load_scene
from cloudrc.metrics import Flight, Number, measure_all
from cloudrc.metrics.verdict import Verdict, flight_evidence, judge, operator_verdict
from cloudrc.record.columns import Recording
from cloudrc.report.document import (
    Run,
    clock_offset_document,
    environment_document,
    report_document,
    write_json,
)

DIFFERS = "By what telemetry had shown when the mission ended, the operator's verdict is "
"""Beginning of the note on an operator's verdict that differs."""
RECORDING_NOTE = "The recording "
"""Beginning of the notes on a recording; a new report replaces the old notes."""


@dataclass(frozen=True)
class Assessment:
    """A run, measured and judged.

    Attributes:
        run: Facts about the run that are not in its recording.
        experiment: The experiment.
        flight: The recorded flight.
        numbers: Measured numbers, without unknown numbers.
        verdict: The verdict on the run.
        notes: Notes for the reader, a sentence each.
        document: Content of report.json.
    """

    run: Run
    experiment: ResolvedExperiment
    flight: Flight
    numbers: dict[str, Number]
    verdict: Verdict
    notes: tuple[str, ...]
    document: dict[str, Any]


def assess(
    recording: Recording,
    experiment: ResolvedExperiment,
    run: Run,
    own: Iterable[str] = (),
) -> Assessment:
    """Measure and judge a run without writing files or drawing figures.

    Args:
        recording: Recording of both ends, on world's clock.
        experiment: The experiment. Metric files named in the experiment are not executed, because
            the experiment may come from somebody else.
        run: Facts about the run that are not in its recording.
        own: The user's own metrics, names or paths; files are executed.
    """
    mission = experiment.mission
    waypoints = mission.steps.count if mission.steps else len(mission.waypoints)
    scene = load_scene(experiment.world.scene)
    flight = Flight(recording, experiment.criteria, waypoints, scene)
    numbers, metric_notes = measure_all(flight, own)
    torn = not recording.complete
    evidence = flight_evidence(
        flight,
        numbers,
        real_time=run.mode != "virtual",
        interrupted=run.interrupted or torn,
    )
    verdict, operator = judge(evidence), None
    if flight.ending is not None:
        operator = operator_verdict(flight, evidence, numbers)
    if operator is not None and operator.outcome == verdict.outcome:
        operator = None
    incomplete = (f"{RECORDING_NOTE}is incomplete: {recording.note}.",) if torn else ()
    remarks = tuple(f"{RECORDING_NOTE}{remark}." for remark in recording.remarks)
    faults = tuple(f"{text[0].upper()}{text[1:]}." for text in recording["/fault"]["text"] if text)
    differs = () if operator is None else (f"{DIFFERS}{operator.outcome}. This report's counts.",)
    notes = (*run.notes, *incomplete, *remarks, *faults, *differs, *metric_notes)
    notes = tuple(dict.fromkeys(notes))
    document = report_document(
        run,
        experiment,
        verdict,
        numbers,
        notes,
        clock_offset=clock_offset_document(recording.metadata),
        complete=not torn,
        operator=operator,
    )
    return Assessment(run, experiment, flight, numbers, verdict, notes, document)


def write_report(
    folder: Path,
    recording: Recording,
    experiment: ResolvedExperiment,
    run: Run,
    *,
    own: Iterable[str] = (),
    page: bool = True,
) -> dict[str, Any]:
    """Write report.json and environment.json, and report.html with its figures.

    Args:
        folder: Folder of the run; files of an earlier report are replaced.
        recording: Recording of both ends, on world's clock.
        experiment: The experiment.
        run: Facts about the run that are not in its recording.
        own: The user's own metrics, as for `assess`.
        page: Whether to write report.html and the figures.

    Returns:
        Content of report.json.

    Raises:
        MissingPrerequisiteError: If `page` is True and matplotlib is not installed; report.json is
            written before the error.
    """
    assessment = assess(recording, experiment, run, own)
    write_json(folder / "report.json", assessment.document)
    environment = environment_document()
    write_json(folder / "environment.json", environment)
    if page:
        _write_page(folder, assessment, environment)
    return assessment.document


def _write_page(folder: Path, assessment: Assessment, environment: dict[str, Any]) -> None:
    try:
        from cloudrc.report.figures import Subject, draw_all
    except ImportError as error:
        raise MissingPrerequisiteError(
            f"report.html needs {error.name}, which is not installed; report.json is written; "
            "for the page, run: pip install 'cloudrc[report]'"
        ) from error
    from cloudrc.report.page import render

    experiment = assessment.experiment
    subject = Subject(assessment.flight, experiment.uplink, experiment.downlink)
    try:
        pictures = draw_all(subject)
    except ValueError as error:  # from matplotlib, for values that no flight has
        raise BadInputError(
            f"{folder}: the recorded values cannot be drawn ({describe_error(error)}); "
            "report.json is written, check the recording"
        ) from error
    figures = folder / "figures"
    if figures.is_symlink():  # a run from somebody else may contain a link to anywhere
        raise BadInputError(f"{figures}: is a link; remove it, figures are kept with their run")
    figures.mkdir(exist_ok=True)
    for picture in pictures:
        write_atomically(figures / f"{picture.name}.png", picture.png)
        write_atomically(figures / f"{picture.name}.svg", picture.svg)
    text = render(
        assessment.run,
        experiment,
        assessment.flight,
        assessment.verdict,
        assessment.numbers,
        assessment.notes,
        pictures,
        environment,
    )
    write_atomically(folder / "report.html", text.encode("utf-8"))


def attachments(folder: Path) -> dict[str, bytes]:
    """Read the attachments of the recording: the configuration and the report."""
    paths = (folder / "config.yaml", folder / "report.json")
    return {path.name: path.read_bytes() for path in paths if path.exists()}
