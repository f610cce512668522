"""Fit the model of a robot's velocity loop to a recorded run."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cloudrc.metrics import velocity_loop
from cloudrc.metrics.velocity_loop import DT, INPUT, OUTPUT, Fit
from cloudrc.record.columns import Recording
from cloudrc.runs.session import refuse_under_way

__all__ = ["INPUT", "OUTPUT", "describe", "identify"]
NAMES = ("time_constant", "dead_time", "gain")


def identify(run: Path) -> tuple[list[Fit], float]:
    """Fit a model per axis to a run, the folder or its MCAP file; also return its duration [s].

    Raise a BadInputError if there is no recording, if the flight has not ended, or if the recording
    does not excite an axis.
    """
    path = run / "mission.mcap" if run.is_dir() else run
    if not path.exists():
        refuse_under_way(path.parent)
    given, measured = velocity_loop.series(Recording.read(path), str(path))
    fits = [
        velocity_loop.identify(given[:, axis], measured[:, axis], f"{path}: {name}")
        for axis, name in enumerate("xyz")
    ]
    return fits, len(given) * DT


def describe(fits: Sequence[Fit], seconds: float) -> dict[str, Any]:
    """Return the content of a file that the predictor `command_history` reads.

    `seconds` is the duration of the recording [s].
    """
    values, halves = (
        {name: [round(float(fit[:2][part][n]), 4) for fit in fits] for n, name in enumerate(NAMES)}
        for part in (0, 1)
    )
    shares = [round(fit.share, 4) for fit in fits]
    more = {"seconds": round(seconds, 2), "input": INPUT, "output": OUTPUT}
    return {**values, "half_width_95": halves, "explained": shares, **more}
