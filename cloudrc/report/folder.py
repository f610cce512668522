"""Read the folder of a run to write a new report; refuse a recording that is not sufficient.

The source of the report is `mission.mcap`. If another program has filtered, cut or replaced this
file, cloudrc writes no report, and the old report stays unchanged.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel

from cloudrc.config.document import parse_yaml
from cloudrc.config.load import ResolvedExperiment, read_experiment
from cloudrc.errors import BadInputError
from cloudrc.files import read
from cloudrc.metrics import METRIC_NOTE
from cloudrc.metrics.flight import CONTROL_TOPICS
from cloudrc.record.columns import Recording
from cloudrc.record.hash import messages_sha256
from cloudrc.record.merge import merge
from cloudrc.record.reader import Contents, NothingReadableError, read_contents
from cloudrc.record.topics import TOPICS
from cloudrc.record.writer import SHA256
from cloudrc.report.document import Run
from cloudrc.report.views import views
from cloudrc.report.write import DIFFERS, RECORDING_NOTE

REPORT_BYTES_MAX = 16 << 20
"""Largest size of a report.json that cloudrc reads [bytes]; large enough for many notes."""
JUDGEMENT = ("criteria", "description", "name", "report")
"""Keys of an experiment that affect the report, but not the flight."""


class _EarlierReport(BaseModel):
    """Values of an earlier report.json that cannot be computed from the recording."""

    mode: Literal["virtual", "local", "cluster"]
    shaper: str
    records_sha256: str | None = None
    verdict: str = ""
    complete: bool = False
    notes: tuple[str, ...] = ()


def read_run(folder: Path) -> tuple[Recording, ResolvedExperiment, Run]:
    """Read the folder of a run; return arguments for `write_report`.

    If the recordings of world and cloud are not merged yet, merge them. Raise a BadInputError if
    the folder has no experiment, or no recording that is sufficient for a report.
    """
    config, merged = folder / "config.yaml", folder / "mission.mcap"
    if not config.is_file():
        raise BadInputError(f"{folder}: has no config.yaml; name the folder of a run")
    experiment = read_experiment(config)
    contents = before = _read_merged(folder)
    if contents is None:
        contents = merge(folder / "world.mcap", folder / "cloud.mcap")
    recording = contents.recording()
    earlier = _earlier_report(folder / "report.json")
    for lack in _lacking(recording, config, whole=earlier is not None and earlier.complete):
        raise BadInputError(f"{merged}: {lack}; no report is written")
    if before is None:
        contents.views = views(recording, experiment)
        contents.write(merged)
    return recording, experiment, _describe(recording, earlier, contents)


def _read_merged(folder: Path) -> Contents | None:
    """Read mission.mcap; return None if it has to be made from world.mcap and cloud.mcap."""
    ends = [(folder / f"{end}.mcap").is_file() for end in ("world", "cloud")]
    if not (folder / "mission.mcap").exists():
        if not any(ends):
            raise BadInputError(f"{folder}: has no mission.mcap; name the folder of a run")
        return None
    try:
        contents = read_contents(folder / "mission.mcap")
    except NothingReadableError:
        if any(ends):
            return None
        raise
    torn = contents.note and not contents.lacking
    return None if torn and all(ends) else contents


def _lacking(recording: Recording, config: Path, *, whole: bool) -> Iterator[str]:
    """Yield the reasons why a recording is not sufficient for a report, the best explanation first.

    `config` is the path of the run's config.yaml. `whole` tells whether the run already has a
    report, made from a complete recording.
    """
    if not any(len(recording[topic]) for topic in TOPICS):
        yield "; ".join(["holds no message of cloudrc", *recording.remarks])
    if recording.lacking:
        yield recording.lacking
    if recording.note and whole:
        yield (
            f"{recording.note}, but report.json describes the whole recording: to report on what"
            " is left, move report.json away"
        )
    if "config.yaml" in recording.attachments:
        there = _flown(recording.attachments["config.yaml"], "its config.yaml")
        here = _flown(read(config), str(config))
        if names := sorted(key for key in there | here if there.get(key) != here.get(key)):
            yield f"is the recording of an experiment with other values for: {', '.join(names)}"
    for topic in ("/ground_truth", *CONTROL_TOPICS):
        steps = np.diff(recording[topic]["stamp_ns"])
        if wrong := int((steps < (topic == "/ground_truth")).sum()):
            yield f"has {wrong} rows on {topic} that are not later than the row before"


def _flown(data: bytes, name: str) -> dict[str, Any]:
    """Parse a configuration; return only the keys that affect the flight."""
    document, _ = parse_yaml(data.decode("utf-8", "replace"), name)
    values = document if isinstance(document, dict) else {}
    return {key: value for key, value in values.items() if key not in JUDGEMENT}


def _earlier_report(source: Path | bytes | None) -> _EarlierReport | None:
    try:
        data = read(source, REPORT_BYTES_MAX) if isinstance(source, Path) else source or b""
        return _EarlierReport.model_validate_json(data)
    except (OSError, ValueError):
        return None


def _describe(recording: Recording, earlier: _EarlierReport | None, contents: Contents) -> Run:
    """Describe a run; take its mode, shaper and notes from its earlier report.

    Without an earlier report, assume a local run if the recording has rows on /lateness, else a
    virtual run.
    """
    if earlier is None:
        real_time = len(recording["/lateness"]) > 0
        mode, shaper = ("local", "relay") if real_time else ("virtual", "virtual")
        earlier = _EarlierReport.model_validate({"mode": mode, "shaper": shaper})
    # The new report makes its own notes with these beginnings.
    anew = (METRIC_NOTE, RECORDING_NOTE, DIFFERS)
    notes = [note for note in earlier.notes if not note.startswith(anew)]
    digest: str | None = messages_sha256(contents.messages)
    if earlier.mode == "virtual":  # the report in the recording has the hash of all records
        unchanged = recording.metadata.get(SHA256, digest) == digest
        kept = _earlier_report(recording.attachments.get("report.json"))
        digest = kept.records_sha256 if kept and unchanged else None
        if not unchanged:
            notes.append(f"{RECORDING_NOTE}was changed after the run: its hash is left out.")
    return Run(
        earlier.mode,
        earlier.shaper,
        digest if recording.complete else None,
        earlier.verdict == "interrupted",
        tuple(notes),
    )
