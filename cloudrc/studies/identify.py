# SPDX-License-Identifier: Apache-2.0

"""Fit the model of a robot's velocity loop to a recorded run."""

from __future__ import annotations

from collections.abc import Sequence
from math import isnan, nan
from pathlib import Path
from typing import Any

import numpy as np

from cloudrc.base.outside.refusal import naming
from cloudrc.base.text import table
from cloudrc.config.load import read_experiment
from cloudrc.results.metrics import velocity_loop
from cloudrc.results.metrics.velocity_loop import DT, INPUT, OUTPUT, Fit
from cloudrc.results.record.columns import Recording
from cloudrc.results.report.flown import flown_world
from cloudrc.results.report.folder import open_recording

NAMES = ("time_constant", "dead_time", "gain")


def identify(run: Path) -> tuple[list[Fit], float, str]:
    """Fit a model per axis to a run, the folder or its MCAP file.

    Also return its duration [s], and the key of robot.yaml to which the model belongs.
    """
    path, recording = open_recording(run)
    planar, tuning = _flown(recording, path.parent)
    fits = []
    with naming(str(path)):
        given, measured = velocity_loop.series(recording)
    for axis, name in enumerate("xy" if planar else "xyz"):
        with naming(f"{path}: {name}"):
            fits.append(velocity_loop.identify(given[:, axis], measured[:, axis]))
    if len(fits) < 3:
        fits.append(_still(fits[0]))
    return fits, len(given) * DT, f"tunings.{tuning}.response" if tuning else "response"


def _flown(recording: Recording, folder: Path) -> tuple[bool, str | None]:
    """Return whether the robot of a run stays on the ground, and its tuning, if a file says so."""
    if not (config := folder / "config.yaml").exists():
        return False, None
    experiment = read_experiment(config, flown=True)
    return flown_world(recording, experiment).planar, experiment.world.tuning


def _still(fit: Fit) -> Fit:
    """Return the model of an axis along which the robot never moves: nothing is measured."""
    constant = np.array([fit.values[0], 0.0, 0.0])
    return Fit(constant, np.full(3, nan), nan)


def _rounded(value: float) -> float | None:
    """Return a number for a file; None if it was not measured."""
    return None if isnan(value) else round(float(value), 4)


def describe(fits: Sequence[Fit], seconds: float, key: str) -> dict[str, Any]:
    """Return the content of a file that the predictor `command_history` reads.

    `seconds` is the duration of the recording [s], `key` the place of the model in robot.yaml.
    """
    values, halves = (
        {name: [_rounded(fit[:2][part][n]) for fit in fits] for n, name in enumerate(NAMES)}
        for part in (0, 1)
    )
    shares = [_rounded(fit.share) for fit in fits]
    more = {"seconds": round(seconds, 2), "input": INPUT, "output": OUTPUT, "robot_yaml": key}
    return {**values, "half_width_95": halves, "explained": shares, **more}


def as_text(fits: Sequence[Fit], seconds: float, key: str) -> str:
    """Format the model of each axis for people; `seconds` [s] and `key` are as in `describe`."""
    head = f"velocity loop from {round(seconds, 2)} s, input {INPUT}, output {OUTPUT}"
    rows = [("axis", "time constant [s]", "dead time [s]", "gain", "explained")]
    for name, fit in zip("xyz", fits, strict=True):
        if isnan(fit.share):
            rows.append((name, "stays on the ground", "", "", ""))
            continue
        constant, dead, gain = (f"{v:.3f} ± {h:.3f}" for v, h in zip(*fit[:2], strict=True))
        rows.append((name, constant, dead, gain, f"{fit.share:.1%}"))
    return f"{head}\n\n{table(rows, right=(1, 2, 3, 4))}\n\n± : 95 % interval\nin robot.yaml: {key}"
