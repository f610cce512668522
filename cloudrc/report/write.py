"""Writes a report: a run's folder and its recording go in; page, figures and numbers come out."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel

from cloudrc.config.load import ResolvedExperiment, read_experiment
from cloudrc.errors import BadInputError, MissingPrerequisiteError, in_words
from cloudrc.files import put, read
from cloudrc.geometry.scene import load_scene
from cloudrc.metrics import METRIC_NOTE, Flight, Number, measure_all
from cloudrc.record.columns import Recording
from cloudrc.report.document import (
    Run,
    Verdict,
    clock_offset_document,
    environment_document,
    judge,
    report_document,
    write_json,
)

BEFORE_MAX = 16 << 20
"""Longest report.json that is read [bytes]; notes may be many."""


@dataclass(frozen=True)
class Assessment:
    """A run, measured and judged.

    Attributes:
        run: What the recording does not say.
        experiment: That was flown.
        flight: As recorded.
        numbers: Measured; those that cannot be known are absent.
        verdict: Success, or what went wrong.
        notes: What a reader should know, a sentence each.
        document: What report.json says.
    """

    run: Run
    experiment: ResolvedExperiment
    flight: Flight
    numbers: dict[str, Number]
    verdict: Verdict
    notes: tuple[str, ...]
    document: dict[str, Any]


class _Before(BaseModel):
    """What is taken over from a report that was written before, whoever wrote it."""

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
    """Measure and judge a run; nothing is written and no picture drawn.

    Args:
        recording: Of both ends, on world's clock.
        experiment: That was flown. The metrics that it names are not run: it may come from
            somebody else.
        run: What the recording does not say.
        own: The user's own metrics, names or paths; they are run.
    """
    mission = experiment.mission
    waypoints = mission.steps.count if mission.steps else len(mission.waypoints)
    scene = load_scene(experiment.world.scene)
    flight = Flight(recording, experiment.criteria, waypoints, scene)
    numbers, troubles = measure_all(flight, own)
    torn = not recording.complete
    verdict = judge(
        flight,
        numbers,
        real_time=run.mode != "virtual",
        interrupted=run.interrupted or torn,
    )
    incomplete = (f"The recording is incomplete: {recording.note}.",) if torn else ()
    faults = tuple(f"{text[0].upper()}{text[1:]}." for text in recording["/fault"]["text"] if text)
    notes = tuple(dict.fromkeys((*run.notes, *incomplete, *faults, *troubles)))
    document = report_document(
        run,
        experiment,
        verdict,
        numbers,
        notes,
        clock_offset=clock_offset_document(recording.metadata),
        complete=not torn,
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
        folder: Of the run; what an earlier report left there is replaced.
        recording: Of both ends, on world's clock.
        experiment: That was flown.
        run: What the recording does not say.
        own: The user's own metrics, as for `assess`.
        page: Whether to draw figures and page; the numbers are written in any case.

    Returns:
        What report.json holds.

    Raises:
        MissingPrerequisiteError: If the page is wanted and matplotlib is not installed; the numbers
            are written before.
    """
    assessment = assess(recording, experiment, run, own)
    write_json(folder / "report.json", assessment.document)
    environment = environment_document()
    write_json(folder / "environment.json", environment)
    if page:
        _write_page(folder, assessment, environment)
    return assessment.document


def read_run(folder: Path) -> tuple[Recording, ResolvedExperiment, Run]:
    """Read what a run left, whole or torn: the arguments of `write_report`.

    If the run died before it could join the recordings of both ends, they are joined now.

    Raises:
        BadInputError: If the folder holds no experiment or no recording that can be read.
    """
    if not (folder / "config.yaml").is_file():
        raise BadInputError(f"{folder}: has no config.yaml; name the folder of a run")
    experiment = read_experiment(folder / "config.yaml")
    recording = _read_recording(folder)
    return recording, experiment, _read_run(folder, recording)


def _read_recording(folder: Path) -> Recording:
    joined = folder / "mission.mcap"
    ends = folder / "world.mcap", folder / "cloud.mcap"
    if not any(path.is_file() for path in (joined, *ends)):
        raise BadInputError(f"{folder}: has no mission.mcap; name the folder of a run")
    try:
        recording = Recording.read(joined)
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
    mission.write(joined)
    return mission.recording()


def _read_run(folder: Path, recording: Recording) -> Run:
    """Learn what the recording does not say from the report that was written before, if any."""
    try:
        before = _Before.model_validate_json(read(folder / "report.json", BEFORE_MAX))
    except (OSError, ValueError):
        # Only in real time do the drivers note how late they are.
        real_time = len(recording["/lateness"]) > 0
        return Run("local", "relay") if real_time else Run("virtual", "virtual")
    # What metrics had to say they say again, unless they have been mended since.
    notes = tuple(note for note in before.notes if not note.startswith(METRIC_NOTE))
    interrupted = before.verdict == "interrupted"
    return Run(before.mode, before.shaper, before.records_sha256, interrupted, notes)


def _write_page(folder: Path, assessment: Assessment, environment: dict[str, Any]) -> None:
    try:
        from cloudrc.report.figures import Subject, draw_all
    except ImportError as error:
        raise MissingPrerequisiteError(
            f"report.html needs {error.name}, which is not installed; report.json is written; "
            "for the page run: pip install 'cloudrc[report]'"
        ) from error
    from cloudrc.report.page import render

    experiment = assessment.experiment
    subject = Subject(assessment.flight, experiment.uplink, experiment.downlink)
    try:
        pictures = draw_all(subject)
    except ValueError as error:  # matplotlib's, of values that no flight has
        raise BadInputError(
            f"{folder}: what is recorded cannot be drawn ({in_words(error)}); report.json is "
            "written, look into the recording"
        ) from error
    figures = folder / "figures"
    if figures.is_symlink():  # of a run got from somebody else: it may lead anywhere
        raise BadInputError(f"{figures}: is a link; remove it, figures are kept with their run")
    figures.mkdir(exist_ok=True)
    for picture in pictures:
        put(figures / f"{picture.name}.png", picture.png)
        put(figures / f"{picture.name}.svg", picture.svg)
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
    put(folder / "report.html", text.encode("utf-8"))
