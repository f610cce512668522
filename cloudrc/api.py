"""The Python API: fly an experiment in virtual time from a program or a notebook.

    import cloudrc

    result = cloudrc.fly("steps", {"cloud.predictor": "last_sample"}, seed=3)
    result.numbers["prediction_error_rms"]  # [m]
    result["/odometry"]["position"]  # [m], numpy, shape (n, 3)

docs/python.md describes the API; other modules may change without notice.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from cloudrc import metrics
from cloudrc.advice import advise
from cloudrc.config.load import dump, load_experiment
from cloudrc.metrics import Flight
from cloudrc.metrics.flight import Columns
from cloudrc.metrics.response import Step, steps
from cloudrc.metrics.verdict import Failure
from cloudrc.record.columns import Recording, Table
from cloudrc.runs.flight import fly_in_memory


@dataclass(frozen=True, eq=False)
class Result:
    """A flight with its verdict, its numbers and its recording.

    `result[topic][column]` is a numpy array; docs/topics.md lists all topics and columns.
    """

    verdict: str  # "success", "failure", or "interrupted" if nothing ended the mission
    failures: tuple[Failure, ...]  # code, text, time [s] and place [m]; the earliest first
    numbers: dict[str, float]  # metric -> value; a number that cannot be known is absent
    units: dict[str, str]  # metric -> SI unit; "1" for counts and shares
    notes: tuple[str, ...]  # sentences for the reader
    config: str  # the resolved experiment as YAML; `cloudrc run` repeats the flight from its file
    records_sha256: str  # hash of all records; equal experiments on one machine have equal hashes
    flight: Flight  # input of metrics: true states, control periods, applied commands

    def __getitem__(self, topic: str) -> Table:
        """Return the table of a topic; raise a KeyError that names all topics."""
        return self.recording[topic]

    @property
    def recording(self) -> Recording:
        """All tables; the stamps of their rows [ns] are on world's clock."""
        return self.flight.recording

    @property
    def applied(self) -> Columns:
        """Commands that world applied, one per row.

        A row also has the values with which cloud computed the command, such as the horizon.
        """
        return self.flight.applied

    @property
    def steps(self) -> tuple[Step, ...]:
        """Response to each step of the setpoint: overshoot, settling time and so on."""
        return steps(self.flight)

    def __repr__(self) -> str:
        """Return the verdict and the first failure in one line."""
        why = f", {self.failures[0].text}" if self.failures else ""
        return f"<Result: {self.verdict}{why}; {len(self.numbers)} numbers>"


def fly(
    experiment: str = "paper", settings: Mapping[str, Any] | None = None, *, seed: int | None = None
) -> Result:
    """Fly in virtual time in this process; no file is written.

    Args:
        experiment: Name of a shipped experiment, or path of a YAML file.
        settings: Changes, as with `--set`: key -> value, such as `{"link.profile": "paper-p3"}`.
            A value may be a list or a mapping.
        seed: Random seed; with None, the seed in the experiment.

    Settings that do not fit together, such as a delay that the guard does not allow, cause a Python
    warning before the flight.

    Returns:
        The result, also if the mission failed.

    Raises:
        cloudrc.errors.BadInputError: If a name, key or value is invalid; the text says where.
    """
    changes = dict(settings or {}) | ({} if seed is None else {"seed": seed})
    texts = [
        f"{key}={json.dumps(value, default=_plain, ensure_ascii=False)}"
        for key, value in changes.items()
    ]
    resolved = load_experiment(experiment, texts)
    metrics.check(resolved.report.metrics)
    for text in advise(resolved):
        warnings.warn(text, stacklevel=2)
    found = fly_in_memory(resolved)
    return Result(
        verdict=found.verdict.outcome,
        failures=found.verdict.failures,
        numbers={name: number.value for name, number in found.numbers.items()},
        units={name: number.unit for name, number in found.numbers.items()},
        notes=found.notes,
        config=dump(resolved),
        records_sha256=found.records_sha256 or "",
        flight=found.flight,
    )


def _plain(value: Any) -> Any:
    """Convert a number or an array of numpy to Python values, and a path to a text."""
    return value.tolist() if hasattr(value, "tolist") else str(value)
