"""Write the report of a run: report.json, environment.json, report.html and figures."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel

from cloudrc.config.load import ResolvedExperiment, read_experiment
from cloudrc.errors import BadInputError, MissingPrerequisiteError, describe_error
from cloudrc.files import read, write_atomically
from cloudrc.geometry.scene import load_scene
from cloudrc.metrics import METRIC_NOTE, Flight, Number, measure_all
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
REPORT_BYTES_MAX = 16 << 20
"""Largest report.json that is read [bytes]; it may have many notes."""


@dataclass(frozen=True)
class Assessment:
    """A run, measured and judged.

    Attributes:
        run: Facts about the run that are not in its recording.
        experiment: The experiment.
        flight: The recorded flight.
        numbers: Measured numbers; unknown ones are absent.
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


class _EarlierReport(BaseModel):
    """Content of an earlier report.json that a new report keeps."""

    mode: Literal["virtual", "local", "cluster"]
    shaper: str
    records_sha256: str | None = None
    verdict: str = ""
    notes: tuple[str, ...] = ()


def assess(
    recording: Recording,
    experiment: ResolvedExperiment,
    run: Run,
    own: Iterable[str] = (),
) -> Assessment:
    """Measure and judge a run without writing files or drawing figures.

    Args:
        recording: Recording of both ends, on world's clock.
        experiment: The experiment. Metric files that it names are not executed: the experiment may
            come from somebody else.
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
    incomplete = (f"The recording is incomplete: {recording.note}.",) if torn else ()
    faults = tuple(f"{text[0].upper()}{text[1:]}." for text in recording["/fault"]["text"] if text)
    differs = () if operator is None else (f"{DIFFERS}{operator.outcome}. This report's counts.",)
    notes = tuple(dict.fromkeys((*run.notes, *incomplete, *faults, *differs, *metric_notes)))
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
            written before.
    """
    assessment = assess(recording, experiment, run, own)
    write_json(folder / "report.json", assessment.document)
    environment = environment_document()
    write_json(folder / "environment.json", environment)
    if page:
        _write_page(folder, assessment, environment)
    return assessment.document


def read_run(folder: Path) -> tuple[Recording, ResolvedExperiment, Run]:
    """Read the folder of a run, complete or torn, as arguments for `write_report`.

    If the run ended before it merged the recordings of both ends, they are merged now.

    Raises:
        BadInputError: If the folder has no experiment or no readable recording.
    """
    if not (folder / "config.yaml").is_file():
        raise BadInputError(f"{folder}: has no config.yaml; name the folder of a run")
    experiment = read_experiment(folder / "config.yaml")
    recording = _read_recording(folder)
    return recording, experiment, _read_run(folder, recording)


def _read_recording(folder: Path) -> Recording:
    merged = folder / "mission.mcap"
    ends = folder / "world.mcap", folder / "cloud.mcap"
    if not any(path.is_file() for path in (merged, *ends)):
        raise BadInputError(f"{folder}: has no mission.mcap; name the folder of a run")
    try:
        recording = Recording.read(merged)
        if recording.complete:
            return recording
    except (BadInputError, FileNotFoundError):
        if not any(path.is_file() for path in ends):
            raise
    else:
        if not all(path.is_file() for path in ends):
            return recording
    from cloudrc.record.merge import merge

    mission = merge(*ends)
    mission.write(merged)
    return mission.recording()


def _read_run(folder: Path, recording: Recording) -> Run:
    """Read mode, shaper, checksum, interruption and notes from an earlier report.json.

    Without one, guess mode and shaper: a run that recorded lateness was in real time.
    """
    try:
        earlier = _EarlierReport.model_validate_json(read(folder / "report.json", REPORT_BYTES_MAX))
    except (OSError, ValueError):
        real_time = len(recording["/lateness"]) > 0
        return Run("local", "relay") if real_time else Run("virtual", "virtual")
    # Metrics and verdicts are made again and write their notes anew.
    notes = tuple(note for note in earlier.notes if not note.startswith((METRIC_NOTE, DIFFERS)))
    interrupted = earlier.verdict == "interrupted"
    return Run(earlier.mode, earlier.shaper, earlier.records_sha256, interrupted, notes)


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
