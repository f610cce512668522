# SPDX-License-Identifier: Apache-2.0

"""Read the folder of a run to write a new report.

The source of the report is `mission.mcap`. If another program has filtered, cut or replaced this
file, cloudrc writes no report, and the old report stays unchanged.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from cloudrc.base.errors import StateError
from cloudrc.base.files import read, read_json
from cloudrc.base.outside.document import parse_yaml
from cloudrc.base.outside.paths import check_there
from cloudrc.base.outside.refusal import reading
from cloudrc.base.text import list_some
from cloudrc.config.load import read_attached, read_experiment
from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.link.cell import Usage
from cloudrc.results.record.columns import Recording
from cloudrc.results.record.merge import merge
from cloudrc.results.record.reader import NothingReadableError
from cloudrc.results.record.topics import TOPICS
from cloudrc.results.record.writer import is_open
from cloudrc.results.report.document import RUN, Run
from cloudrc.results.report.views import views
from cloudrc.results.under_way import JOURNAL_FILE, under_way

REPORT_BYTES_MAX = 16 << 20
"""Largest size of a report.json that cloudrc reads [bytes]; large enough for many notes."""
ROBOT = "robot-"
"""Beginning of the names of folders in the folder of a fleet; the robot's number follows."""
JUDGEMENT = ("criteria", "description", "name", "report")
"""Keys of an experiment that affect the report, but not the flight."""


def read_run(folder: Path) -> tuple[Recording, ResolvedExperiment, Run]:
    """Read the folder of a run; return arguments for `write_report`.

    If the recordings of world and cloud are not merged yet, merge them. Raise a StateError
    if the recording is not sufficient for a report.
    """
    config, merged = folder / "config.yaml", folder / "mission.mcap"
    check_there(config, "name the folder of a run")
    experiment = read_experiment(config, flown=True)
    before = _read_merged(folder)
    recording = before or merge(folder / "world.mcap", folder / "cloud.mcap")
    whole = read_json(folder / "report.json", REPORT_BYTES_MAX).get("complete") is True
    for lack in _lacking(recording, config, whole=whole):
        raise StateError(f"{merged}: {lack}; no report is written")
    run = _read_facts(recording)
    if before is None:
        run = replace(run, interrupted=True)  # the command was killed before it wrote mission.mcap
        recording.metadata |= run.metadata
        recording.views = views(recording, experiment)
        recording.write(merged)
    return recording, experiment, run


def check_ended(folder: Path) -> None:
    """Raise a StateError if the flight whose files are in a folder has not ended."""
    if folder.resolve() not in under_way() and not is_open(folder / "mission.mcap"):
        return
    if (folder / JOURNAL_FILE).is_file():
        raise StateError(f"{folder}: the session has not ended; end it: cloudrc down")
    raise StateError(f"{folder}: the flight has not ended; wait for its end")


def open_recording(run: Path) -> tuple[Path, Recording]:
    """Read the whole recording of a run that has ended: its folder, or its MCAP file.

    Also return the path of the file.
    """
    file = run / "mission.mcap" if run.is_dir() else run
    check_ended(file.parent)
    check_there(file, "name the folder of a run, or a file")
    return file, Recording.read(file, whole=True)


def read_flown(run: Path) -> tuple[Recording, ResolvedExperiment]:
    """Read recording and experiment of a run that has ended: its folder or its MCAP file."""
    if run.is_dir():
        check_ended(run)
        recording, experiment, _ = read_run(run)
        return recording, experiment
    _, recording = open_recording(run)
    return recording, read_attached(recording.attachments, str(run))


def robots_in(folder: Path) -> list[Path]:
    """Return the folders of the robots, by number, if `folder` is that of a fleet; else []."""
    found = {path.name.removeprefix(ROBOT): path for path in folder.glob(f"{ROBOT}*")}
    return [found[number] for number in sorted(filter(str.isdecimal, found), key=int)]


def read_cell(path: Path) -> list[Usage]:
    """Read cell.csv, what the cell of a fleet did; without this file there was no cell."""
    if not path.exists():
        return []
    with reading(path, "is no record of a cell"), path.open(encoding="utf-8", newline="") as file:
        return [*map(Usage.read, csv.DictReader(file))]


def _read_merged(folder: Path) -> Recording | None:
    """Read mission.mcap; return None if it has to be made from world.mcap and cloud.mcap."""
    ends = [(folder / f"{end}.mcap").is_file() for end in ("world", "cloud")]
    if not (folder / "mission.mcap").exists():
        if not any(ends) and (robots := robots_in(folder)):
            names = list_some([robot.name for robot in robots], 5)
            raise StateError(f"{folder}: is a fleet; name one of its robots: {names}")
        if not any(ends):
            check_there(folder / "mission.mcap", "name the folder of a run")
        return None
    try:
        recording = Recording.read(folder / "mission.mcap")
    except NothingReadableError:
        if any(ends):
            return None
        raise
    # A mission.mcap that is whole has the facts about the run, even if the file of an end was torn.
    return None if recording.unread and all(ends) else recording


def _lacking(recording: Recording, config: Path, *, whole: bool) -> Iterator[str]:
    """Yield the reasons why a recording is not sufficient for a report, the best explanation first.

    `config` is the path of the run's config.yaml. `whole` tells whether the run already has a
    report, made from a complete recording.
    """
    if not sum(len(recording[topic]) for topic in TOPICS):  # all topics: each must be readable
        yield "; ".join(["holds no message of cloudrc", *recording.remarks])
    if recording.note and whole:
        yield (
            f"{recording.note}, but report.json describes the whole recording: to report on what"
            " is left, move report.json away"
        )
    if "config.yaml" in recording.attachments:
        there = _flown(recording.attachments["config.yaml"], "config.yaml")
        here = _flown(read(config), str(config))
        if names := sorted(key for key in there | here if there.get(key) != here.get(key)):
            yield f"is the recording of an experiment with other values for: {', '.join(names)}"


def _flown(data: bytes, name: str) -> dict[str, Any]:
    """Parse a configuration; return only the keys that affect the flight."""
    document, _ = parse_yaml(data.decode("utf-8", "replace"), name)
    values = document if isinstance(document, dict) else {}
    return {key: value for key, value in values.items() if key not in JUDGEMENT}


def _read_facts(recording: Recording) -> Run:
    """Return the facts about a run that its recording contains.

    A torn recording may not contain them. Then assume a local run if the recording has rows on
    /lateness, else a virtual run.
    """
    if facts := recording.metadata.get(RUN):
        return TypeAdapter(Run).validate_json(facts)
    return Run("local", "relay") if len(recording["/lateness"]) else Run("virtual", "virtual")
