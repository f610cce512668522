"""Score the exercise of docs/exercise.md: formulas on given samples, then flights in virtual time.

The exercise has three parts: estimator, predictor and controller. The reference is cloudrc's own
plug-ins. A flight that scores one part uses the reference for the other two parts, so that an error
in one part costs no points of another part.
"""

from __future__ import annotations

import json
import os
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cloudrc import plugins
from cloudrc.api import fly
from cloudrc.cloud.estimators import DelaySample
from cloudrc.errors import BadInputError, CloudrcError, describe_error, to_one_line
from cloudrc.messages import UPRIGHT, ZERO, Odometry, Setpoint

PARTS = {
    "estimator": ("delay_estimator.py", "horizon", "running_mean"),
    "predictor": ("predictor.py", "predict", "constant_velocity"),
    "controller": ("controller.py", "update", "pid"),
}
"""Part -> the student's file, the method that returns its result, and the reference."""
TOLERANCE = 1e-3
"""Largest difference between a result and that of the reference, in SI units."""
FAILED = 0.3
"""Largest share of its points that a failed flight can get, in [0, 1]."""
STATE = Odometry(10**9, (1.0, -2.0, 0.7), (0.6, 0.0, 0.0, 0.8), (0.5, 0.3, -0.2), (0.3, -0.2, 0.8))


def _horizons(build: Callable[[], Any], *delays: float, hold: float = 0.0) -> Any:
    """Return the horizons [s] of an estimator: before the first delay, and after each delay.

    `delays` are loop delays [s]. Each includes `hold` [s], the time from a command's application to
    the sending of its echo.
    """
    estimator = build()
    seen = [estimator.horizon(7.0)]
    for delay in delays:
        estimator.update(DelaySample(delay, delay - hold))
        seen.append(estimator.horizon(7.0))
    return seen


def _predict(build: Callable[[], Any], select: Callable[[Odometry], Any]) -> Any:
    return [select(build().predict(STATE, horizon)) for horizon in (0.0, 0.1, 0.3)]


def _command(
    build: Callable[..., Any], n: int = 1, speed: float = 0.0, sign: bool = False, **gains: Any
) -> Any:
    """Return two commands of a controller with `gains`: the last before and first after a reset.

    Before the reset, the controller gets `n` updates, 2 ms apart, of a robot at `speed` [m/s]. A
    command is a velocity [m/s]. If `sign` is False, return absolute values.
    """
    controller, (x, y, z), seen = build(**gains), STATE.position, ZERO
    setpoint = Setpoint((2.0, -1.0, 0.2))
    for k in range(n):
        position = (x + 0.002 * k * speed, y, z)
        state = Odometry(k * 2_000_000, position, UPRIGHT, (speed, 0.0, 0.0), ZERO)
        seen = controller.update(state, setpoint, 0.002).velocity
    controller.reset()
    both = [seen, controller.update(STATE._replace(velocity=ZERO), setpoint, 0.002).velocity]
    return both if sign else np.abs(both)


class Formula(NamedTuple):
    """A test that compares the results of the student's plug-in with those of a correct plug-in."""

    test: str
    points: int
    measure: Callable[[Callable[..., Any]], Any]

    def score(self, files: Mapping[str, str]) -> tuple[float, str]:
        """Return 1.0 and "right" if the student's results agree with those of the reference.

        Otherwise raise a BadInputError. `files` has one entry: part -> path of the student's file.
        """
        ((part, path),) = files.items()
        builds = (partial(plugins.load, f"{part}s", name) for name in (path, PARTS[part][2]))
        seen, wanted = (np.asarray(self.measure(build), dtype=float) for build in builds)
        if seen.shape == wanted.shape:
            wrong = ~np.isclose(seen, wanted, rtol=0.0, atol=TOLERANCE)
            if not wrong.any():
                return 1.0, "right"
            first = int(np.argwhere(wrong)[0, 0]) if wrong.ndim > 1 else slice(None)
            seen, wanted = seen[first], wanted[first]
        raise BadInputError(f"gives {seen.round(3).tolist()}, not {wanted.round(3).tolist()}")


class Flight(NamedTuple):
    """A test flight; the value of one metric decides how many of the points the student gets.

    The value `full` or better gives all points, `none` or worse gives 0; linear in between.
    """

    test: str
    points: int
    experiment: str
    link: str
    metric: str
    full: float  # any unit
    none: float  # any unit

    def score(self, files: Mapping[str, str]) -> tuple[float, str]:
        """Fly with `files` (plug-in -> path); return the earned share of points [1], and why."""
        chosen = {f"cloud.{part}": path for part, path in files.items()}
        result = fly(self.experiment, {**chosen, "link.profile": self.link})
        value = result.numbers.get(self.metric, self.none)
        share = min(max((value - self.none) / (self.full - self.none), 0.0), 1.0)
        seen = f"{self.metric} {value:.3g} (all points: {self.full:g}, none: {self.none:g})"
        if result.failures:
            texts = {failure.code: failure.text for failure in result.failures}
            share *= 0.0 if "plugin_failed" in texts else FAILED
            seen += f"; {texts.get('plugin_failed', result.failures[0].text)}"
        return share, seen


CHECKS: dict[str, tuple[Formula | Flight, ...]] = {
    "estimator": (
        Formula("mean", 10, lambda build: _horizons(build, 0.08, 0.14, 0.05, 0.11, 0.2)),
        Formula("hold time", 5, lambda build: _horizons(build, 0.1, hold=0.04)),
        Flight("steps", 10, "steps", "paper-p3", "delay_estimate_error_rms", 0.025, 0.06),
    ),
    "predictor": (
        Formula("position", 6, partial(_predict, select=lambda o: o.position)),
        Formula("orientation", 5, partial(_predict, select=lambda o: o.orientation_wxyz)),
        Formula("velocity, stamp", 4, partial(_predict, select=lambda o: (*o[3], o[0] / 1e9))),
        Flight("steps", 10, "steps", "paper-p3", "prediction_error_rms", 0.015, 0.04),
    ),
    "controller": (
        Formula("P", 5, partial(_command, sign=True, gain_p=(0.5, 1.0, 2.0))),
        Formula("I", 4, partial(_command, n=1000, gain_i=(0.25, 0.25, 0.25))),
        Formula("D", 3, partial(_command, n=9, speed=0.5, gain_d=(0.4, 0.4, 0.4))),
        Formula("limit", 3, partial(_command, velocity_max=(0.3, 0.4, 0.5))),
        Flight("steps", 10, "steps", "paper-p3", "iae_mean", 1.8, 4.0),
    ),
    "together": (
        Flight("pipes, paper-p2", 10, "paper", "paper-p2", "waypoints_reached", 7, 0),
        Flight("pipes, satellite", 15, "paper", "satellite", "waypoints_reached", 7, 0),
    ),
}
"""Part, or all parts together -> its checks; 100 points in total."""


def rows(part: str, scored: Sequence[tuple[float, str]]) -> list[dict[str, Any]]:
    """Make a row per check of `part` from its score in [0, 1] and a text on the result."""
    keys = ("part", "test", "points", "max_points", "seen")
    cells = (
        (part, check.test, round(check.points * share, 1), check.points, seen)
        for check, (share, seen) in zip(CHECKS[part], scored, strict=True)
    )
    return [dict(zip(keys, cell, strict=True)) for cell in cells]


def run(part: str, folder: Path) -> list[dict[str, Any]]:
    """Run the checks of a part on the files in `folder`; return a dictionary per check."""
    names, scored = PARTS if part == "together" else (part,), list[tuple[float, str]]()
    files = {name: str(folder / PARTS[name][0]) for name in names}
    for check in CHECKS[part]:
        name = part
        try:
            for name, path in files.items():
                plugins.load(f"{name}s", path)
            scored.append(check.score(files))
        except BaseException as error:  # a student's file may raise anything, SystemExit too
            seen = to_one_line(_explain(error, name, files)).replace(f"{folder}/", "")
            scored.append((0.0, seen))
    return rows(part, scored)


def _explain(error: BaseException, part: str, files: Mapping[str, str]) -> str:
    """Describe an error; begin with FILE:LINE, the place in the student's file that failed.

    If no line of this file failed, the place is the student's method.
    """
    while isinstance(error, CloudrcError) and error.__cause__ is not None:
        error = error.__cause__
    places = [(each.filename, each.lineno) for each in traceback.extract_tb(error.__traceback__)]
    if isinstance(error, SyntaxError):
        places.append((str(error.filename), error.lineno))
    places = [place for place in places if place[0] in files.values()]
    if not places and (path := Path(files[part])).is_file():
        before = path.read_text(errors="replace").partition(f"def {PARTS[part][1]}(")[0]
        places = [(str(path), before.count("\n") + 1)]
    text = str(error) if isinstance(error, CloudrcError) else describe_error(error)
    return f"{places[-1][0]}:{places[-1][1]}: {text}" if places else text


if __name__ == "__main__":  # part, folder, file for the rows
    part, folder, answer = sys.argv[1:]
    Path(answer).write_text(json.dumps(run(part, Path(folder))))
    os._exit(0)  # the student's files may have started threads
