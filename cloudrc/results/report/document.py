# SPDX-License-Identifier: Apache-2.0

"""Build the documents report.json and environment.json."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any, Literal

from cloudrc.config.link_schedule import link_start
from cloudrc.config.resolved import ResolvedExperiment, fingerprint
from cloudrc.results.metrics.budget import budget_of
from cloudrc.results.metrics.flight import Flight
from cloudrc.results.metrics.measure import Number
from cloudrc.results.metrics.response import steps
from cloudrc.results.metrics.verdict import FlightVerdict

SCHEMA_VERSION = 1
RUN = "run"
"""Metadata key of mission.mcap: facts about the run, as JSON."""
ENVIRONMENT_FILE, FILES = "environment.json", "files"
"""Name of the file about the machine of a flight, and its key for the hashes of files."""
INCOMPLETE = "The recording is incomplete"
"""Beginning of the note on what a recording has lost."""
PACKAGES = (
    "cloudrc",
    "mujoco",
    "numpy",
    "pydantic",
    "pyyaml",
    "cryptography",
    "mcap",
    "rosbags",
    "matplotlib",
)
"""Packages whose versions can change the results of a run or a report."""


@dataclass(frozen=True, slots=True)
class Run:
    """Facts about a run that are not in its records."""

    mode: Literal["virtual", "local", "cluster"]
    shaper: str  # what emulated the link: "virtual", "relay" or "netem"
    interrupted: bool = False  # whether the user stopped the run
    notes: tuple[str, ...] = ()  # sentences for the reader of the report
    physics_steps: str = ""  # code of the physics steps, such as "C (compiled by cc)"; "": unknown
    camera: Mapping[str, str] | None = None  # what renders and encodes its pictures
    # Dotted key of each of the user's files -> hash of its content before the flight.
    files: Mapping[str, str] = field(default_factory=dict)

    @property
    def metadata(self) -> dict[str, str]:
        """The entry for the metadata of the run's recording."""
        return {RUN: json.dumps(asdict(self))}


@dataclass(frozen=True)
class Assessment:
    """A run with its measurements and its verdict."""

    run: Run
    experiment: ResolvedExperiment
    flight: Flight
    numbers: dict[str, Number]  # metric -> value, for metrics with a known value
    verdict: FlightVerdict
    operator: FlightVerdict | None  # what telemetry told the operator at the end, if it differs
    notes: tuple[str, ...]  # sentences for the reader of the report
    records_sha256: str | None  # hash of the recording; None if the recording is incomplete
    traceback: str | None  # of the first failure of a plug-in or a metric, if one failed
    metric_notes: tuple[str, ...]  # those of `notes` about metrics without a value

    @property
    def code(self) -> str | None:
        """Hash of the sources that have flown; None for a recording that does not name it."""
        return self.flight.recording.metadata.get("code")

    @property
    def document(self) -> dict[str, Any]:
        """The content of report.json."""
        recording, numbers = self.flight.recording, self.numbers.items()
        values = {name: {"value": number.value, "unit": number.unit} for name, number in numbers}
        return _known(
            {
                "schemaVersion": SCHEMA_VERSION,
                **_verdict_document(self.verdict),
                "operator_verdict": self.operator and _verdict_document(self.operator),
                "experiment": self.experiment.name,
                "config_sha256": fingerprint(self.experiment),
                "code": self.code,
                "mode": self.run.mode,
                "seed": self.experiment.seed,
                "link_start": link_start(self.experiment),
                "shaper": self.run.shaper,
                "records_sha256": self.records_sha256,
                "numbers": values,
                "budget": budget_of(self.flight).document,
                "steps": [_known(step._asdict()) for step in steps(self.flight)]
                if self.experiment.mission.steps
                else None,
                "clock_offset": clock_offset_document(recording.metadata),
                "complete": not recording.note,
                "traceback": self.traceback,
                "notes": list(self.notes),
            }
        )


def clock_offset_document(metadata: Mapping[str, str]) -> dict[str, Any] | None:
    """Describe how cloud's stamps were converted to world's clock; None if both have one clock."""
    method = metadata.get("clock_offset_method", "same clock")
    if method == "same clock":
        return None
    found: dict[str, Any] = {"method": method}
    if uncertainty := metadata.get("clock_offset_uncertainty_ns"):
        found["uncertainty"] = {"value": int(uncertainty) * 1e-9, "unit": "s"}
    return found


def environment_document(
    physics_steps: str = "",
    code: str | None = None,
    files: Mapping[str, str] | None = None,
    camera: Mapping[str, str] | None = None,
) -> dict[str, Any]:
    """Describe the software and hardware of this machine, without names of users and hosts.

    `physics_steps` names the code of the physics steps, such as "C (compiled by cc)"; "" if this is
    unknown. `code` is a hash of the sources that have flown; None if this is unknown. `files` are
    the hashes of the user's files, by key. `camera` names what renders and encodes pictures.
    """
    document = {
        "schemaVersion": SCHEMA_VERSION,
        "python": platform.python_version(),
        "packages": versions(PACKAGES),
        "system": f"{platform.system()} {platform.release()}",
        "architecture": platform.machine(),
        "processor": _processor(),
        "cores": os.cpu_count(),
        "code": code,
        "physics_steps": physics_steps or None,
        "camera": camera,
        FILES: files or None,
    }
    return _known(document)


def versions(names: Iterable[str]) -> dict[str, str]:
    """Return the versions of packages; leave out those that are not installed."""
    return _known({name: _version(name) for name in names})


@cache
def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    models = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(models, platform.processor())


def _verdict_document(verdict: FlightVerdict) -> dict[str, Any]:
    failures = [
        _known({**asdict(failure), "place": failure.place and list(failure.place)})
        for failure in verdict.failures
    ]
    return {"verdict": verdict.outcome, "failures": failures}


def _known(entries: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in entries.items() if value is not None}
