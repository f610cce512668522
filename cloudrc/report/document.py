"""The files for programs: what was measured and judged becomes report.json and environment.json."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

from cloudrc.config.load import ResolvedExperiment, fingerprint
from cloudrc.files import put
from cloudrc.metrics import Number
from cloudrc.report.verdict import Failure, Verdict

SCHEMA_VERSION = 1
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
"""Those whose version can change what a run or its report says."""


@dataclass(frozen=True, slots=True)
class Run:
    """What the recording itself does not say about a run.

    Attributes:
        mode: "virtual", "local" or "cluster".
        shaper: What emulated the link: "virtual", "relay" or "netem".
        records_sha256: Of all records in virtual time, of all messages in real time, by
            `record.hash`; None if they are not all there.
        interrupted: True if somebody stopped it.
        notes: What a reader should know, a sentence each.
    """

    mode: str
    shaper: str
    records_sha256: str | None = None
    interrupted: bool = False
    notes: tuple[str, ...] = ()


def report_document(
    run: Run,
    experiment: ResolvedExperiment,
    verdict: Verdict,
    numbers: Mapping[str, Number],
    notes: Sequence[str],
    *,
    clock_offset: Mapping[str, Any] | None,
    complete: bool,
) -> dict[str, Any]:
    """Put together what report.json says.

    Args:
        run: What the recording does not say.
        experiment: That was flown.
        verdict: Of it.
        numbers: Measured; what is not in it cannot be known and stays absent.
        notes: What a reader should know, a sentence each.
        clock_offset: How cloud's stamps came on world's clock, by `clock_offset_document`.
        complete: False if the recording is torn.
    """
    document = {
        "schemaVersion": SCHEMA_VERSION,
        "verdict": verdict.outcome,
        "failures": [_failure(failure) for failure in verdict.failures],
        "experiment": experiment.name,
        "config_sha256": fingerprint(experiment),
        "mode": run.mode,
        "seed": experiment.seed,
        "shaper": run.shaper,
        "records_sha256": run.records_sha256,
        "numbers": {
            name: {"value": number.value, "unit": number.unit} for name, number in numbers.items()
        },
        "clock_offset": clock_offset,
        "complete": complete,
        "notes": list(notes),
    }
    return _known(document)


def clock_offset_document(metadata: Mapping[str, str]) -> dict[str, Any] | None:
    """Say how cloud's stamps were put on world's clock.

    Args:
        metadata: Of the recording.

    Returns:
        The method and, where it is known, the uncertainty; None if both ends share a clock.
    """
    method = metadata.get("clock_offset_method", "same clock")
    if method == "same clock":
        return None
    uncertainty_ns = metadata.get("clock_offset_uncertainty_ns")
    known = None if uncertainty_ns is None else {"value": int(uncertainty_ns) * 1e-9, "unit": "s"}
    return _known({"method": method, "uncertainty": known})


def environment_document() -> dict[str, Any]:
    """Say on what the report was made: nothing in it names a user or a machine."""
    return {
        "schemaVersion": SCHEMA_VERSION,
        "python": platform.python_version(),
        "packages": {name: version for name in PACKAGES if (version := _version(name))},
        "system": f"{platform.system()} {platform.release()}",
        "architecture": platform.machine(),
        "processor": _processor(),
        "cores": os.cpu_count(),
    }


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Write a document for people and programs; numbers that are not finite are refused."""
    text = json.dumps(document, indent=2, allow_nan=False, ensure_ascii=False)
    put(path, f"{text}\n".encode())


def _failure(failure: Failure) -> dict[str, Any]:
    place = None if failure.place is None else list(failure.place)
    return _known({**asdict(failure), "place": place})


def _known(entries: dict[str, Any]) -> dict[str, Any]:
    """Leave out what is not known: absent, never zero or null."""
    return {name: value for name, value in entries.items() if value is not None}


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _processor() -> str:
    """The processor's model where the system tells, else what Python knows of it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    models = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(models, platform.processor())
