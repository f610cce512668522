# SPDX-License-Identifier: Apache-2.0

"""Write the report of a run: report.json, environment.json and, if wanted, page and figures."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from html import escape
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any

import numpy as np

from cloudrc.base.errors import CloudrcError, describe_error
from cloudrc.base.files import read_json, write_atomically, write_json
from cloudrc.config.faults import CLOUD_KILLED, WORLD_PAUSED, acting
from cloudrc.config.link_schedule import link_start
from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.config.setpoints import DRIVE_FILE, write_setpoints
from cloudrc.physics.geometry.obstacles import has_surface, obstacles
from cloudrc.results.metrics.flight import Flight, select
from cloudrc.results.metrics.measure import measure_all
from cloudrc.results.metrics.mission import came_up
from cloudrc.results.metrics.verdict import flight_evidence, judge, operator_verdict
from cloudrc.results.record.columns import Recording
from cloudrc.results.report.document import (
    ENVIRONMENT_FILE,
    INCOMPLETE,
    Assessment,
    Run,
    environment_document,
)
from cloudrc.results.report.flown import flight_of, flown_shapes, flown_world

if TYPE_CHECKING:
    from cloudrc.results.report.figures.style import Look, Subject


UNKNOWN = "No clearance is known from"
"""Beginning of a note about obstacles without a declared shape."""


def assess(
    recording: Recording, experiment: ResolvedExperiment, run: Run, own: Iterable[str] = ()
) -> Assessment:
    """Measure and judge a run without writing files or drawing figures.

    `own` are names or paths of the user's metrics, whose files are executed. Metric files that only
    the experiment names are not executed, because somebody else may have written them.
    """
    flight = flight_of(recording, experiment)
    numbers, unmeasured, traceback = measure_all(flight, own)
    # A file that is cut short does not tell that the run was interrupted.
    evidence = flight_evidence(
        flight,
        numbers,
        real_time=run.mode != "virtual",
        interrupted=run.interrupted,
        kills=len(acting(experiment.faults, CLOUD_KILLED)),
        paused=sum(each.length for each in acting(experiment.faults, WORLD_PAUSED)),
    )
    verdict, operator = judge(evidence), None
    notes = list(run.notes)
    if recording.note:
        notes.append(f"{INCOMPLETE}: {recording.note}.")
    notes += [f"The recording {remark}." for remark in recording.remarks]
    notes += [f"{text[0].upper()}{text[1:]}." for text in recording["/fault"]["text"] if text]
    notes += _remarks(flight, experiment)
    if flight.ending is not None:
        seen = operator_verdict(flight, evidence, numbers)
        if seen.outcome != verdict.outcome:
            operator = seen
            notes.append(
                "From telemetry at the end of the mission, the operator's verdict was "
                f"{seen.outcome}. The verdict of this report counts."
            )
    about = tuple(dict.fromkeys(unmeasured))
    kept = tuple(dict.fromkeys([*notes, *about]))
    digest = None if recording.note else recording.sha256
    # A plug-in in flight comes before a metric.
    first = next(filter(None, [*recording["/fault"]["traceback"], traceback]), None)
    return Assessment(
        run, experiment, flight, numbers, verdict, operator, kept, digest, first, about
    )


def _remarks(flight: Flight, experiment: ResolvedExperiment) -> Iterator[str]:
    """Yield what a reader of the numbers has to know about robot, cloud, faults and scene."""
    robot, scene = PurePath(experiment.world.robot), flight.scene
    if robot.suffix == ".xml":
        yield (
            f"The robot is the model {robot.name} alone, without a robot.yaml: its onboard "
            "controller and its guard have default values."
        )
    if clamped := round(flight.growth("horizon_clamped") or 0):
        yield (
            f"In {clamped} periods, the estimator's horizon was not in the range 0 to "
            f"{experiment.cloud.horizon_max_s:g} s (cloud.horizon_max_s), and cloud limited it; a "
            "horizon is in seconds."
        )
    if experiment.faults and flight.end_ns is not None:
        ended = flight.duration - came_up(flight, link_start(experiment) or 0.0)
        for fault in experiment.faults:
            if fault.at_s >= ended:
                yield (
                    f"The fault {fault.kind} at {fault.at_s:g} s did nothing: the mission ended "
                    f"{ended:.1f} s after the link had come up."
                )
    found = obstacles(scene, touch=flight.mission.touched)
    if flight.hull is None:
        yield f"{UNKNOWN} anything: the size of the robot is not known here."
    elif scene.path is not None:
        yield f"{UNKNOWN} all bodies but declared tubes: MuJoCo is not installed."
    elif unknown := sorted({each.name for each in found if not has_surface(each)}):
        yield f"{UNKNOWN} {', '.join(unknown)}: of a height field, only the box around it is."
    if scene.intangible:
        yield (
            f"The robot flies through {', '.join(scene.intangible)}: by contype and conaffinity, "
            "their geoms never meet those of the robot."
        )


def write_report(
    folder: Path,
    recording: Recording,
    experiment: ResolvedExperiment,
    run: Run,
    *,
    own: Iterable[str] = (),
    page: bool = True,
    figures: bool = False,
    look: Look | None = None,
) -> dict[str, Any]:
    """Write report.json; if `page`, report.html; if `figures`, the files in figures/.

    Also write environment.json, if the flight has left none.

    `folder` is the folder of the run; files of an earlier report in it are replaced. `look` is the
    size of the figures. `own` are names or paths of the user's metrics, whose files are executed.
    Return the content of report.json.
    """
    assessment = assess(recording, experiment, run, own)
    document = assessment.document
    write_json(folder / "report.json", document)
    environment = _environment(folder / ENVIRONMENT_FILE, assessment)
    _write_drive(folder / DRIVE_FILE, assessment)
    if page or figures:
        _draw(folder, assessment, environment, look, page=page, figures=figures)
    return document


def _environment(path: Path, assessment: Assessment) -> dict[str, Any]:
    """Read from `path` which machine flew; without a valid file, write one for this machine."""
    if not path.is_symlink() and (known := read_json(path)):
        return known
    run = assessment.run
    document = environment_document(run.physics_steps, assessment.code, run.files, run.camera)
    write_json(path, document)
    return document


def _write_drive(path: Path, assessment: Assessment) -> None:
    """Write the setpoints of the operator's drive by hand, if there was one, as CSV."""
    flight = assessment.flight
    mission, control = flight.during("/mission"), flight.control
    begins_ns = mission["stamp_ns"][mission["event"] == "driving"]
    if not len(begins_ns):
        return
    by_hand = (control["stamp_ns"] >= begins_ns[0]) & (control["waypoint"] < 0)
    driven = select(control, np.flatnonzero(by_hand)[::2])  # 50 Hz are enough
    if len(driven["stamp_ns"]) > 1:
        times = (driven["stamp_ns"] - begins_ns[0]) * 1e-9
        fence = flown_world(flight.recording, assessment.experiment).steered
        setpoints = zip(times.tolist(), driven["setpoint"].tolist(), strict=True)
        write_atomically(path, write_setpoints(setpoints, fence).encode())


def _draw(
    folder: Path,
    assessment: Assessment,
    environment: dict[str, Any],
    look: Look | None,
    *,
    page: bool,
    figures: bool,
) -> None:
    """Draw a run; write report.html, the files in figures/, or both."""
    from cloudrc.results.report.figures import PAGE_KINDS, PRINT_KINDS, draw_all, draw_still
    from cloudrc.results.report.page import render
    from cloudrc.results.report.polar import write_polar

    subject = subject_of(assessment, look)
    pictures = draw_all(subject, PRINT_KINDS if figures else PAGE_KINDS)
    if figures:
        if (target := folder / "figures").is_symlink():
            target.unlink()  # in a run from somebody else, the link may point anywhere
        target.mkdir(exist_ok=True)
        for picture in pictures:
            for kind, content in picture.files.items():
                write_atomically(target / f"{picture.name}.{kind}", content)
    if page:
        still = draw_still(subject) if len(assessment.flight.truth["position"]) else None
        moving = _replay(assessment), write_polar(assessment.flight)
        text = render(assessment, pictures, environment, *moving, still)
        write_atomically(folder / "report.html", text.encode("utf-8"))


def subject_of(assessment: Assessment, look: Look | None = None) -> Subject:
    """Return what figures of a run show; `look` is their size."""
    from cloudrc.results.report.figures.style import Look, Subject

    flown = assessment.experiment
    shapes = flown_shapes(assessment.flight.recording, flown)
    ways, start = (flown.uplink, flown.downlink), link_start(flown) or 0.0
    return Subject(assessment.flight, *ways, look or Look(), shapes, start, flown.faults)


def _replay(assessment: Assessment) -> str:
    """Return the 3-D replay as HTML, or a line with the reason why it is missing."""
    try:
        from cloudrc.results.report.replay import write_section

        return write_section(assessment.flight, assessment.experiment)
    except ImportError as error:
        why = f"{error.name} is not installed; run: pip install 'cloudrc[console]'"
    except (CloudrcError, OSError) as error:
        why = describe_error(error)
    return f'<p class="note" id="replay">No replay in 3-D: {escape(why)}</p>'


def attachments(folder: Path) -> dict[str, bytes]:
    """Read the files to attach to a recording, config.yaml and report.json: name -> content."""
    paths = (folder / "config.yaml", folder / "report.json")
    return {path.name: path.read_bytes() for path in paths if path.exists()}
