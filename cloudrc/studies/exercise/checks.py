# SPDX-License-Identifier: Apache-2.0

"""Score the parts of a task: formulas on given samples, and flights in virtual time.

A flight that scores one part flies with the experiment's own plug-ins for all other parts, so that
an error in one part costs no points of another part. The references of the formulas are cloudrc's
own plug-ins.
"""

from __future__ import annotations

import json
import os
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from cloudrc.base import plugins
from cloudrc.base.errors import CloudrcError, PlacedError, describe_error
from cloudrc.base.outside import code
from cloudrc.base.outside.document import read_document
from cloudrc.base.outside.values import WHOLE, InvalidValueError
from cloudrc.cloud.estimators import DelaySample
from cloudrc.config.load import load_experiment
from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.config.task import FormulaName, Task, TestConfig
from cloudrc.flight.in_memory import fly_in_memory
from cloudrc.flight.own_files import hash_all
from cloudrc.results.metrics import measure
from cloudrc.wire.messages import UPRIGHT, ZERO, Odometry, Setpoint

REFERENCES = {"estimator": "running_mean", "predictor": "constant_velocity", "controller": "pid"}
"""Part -> cloudrc's plug-in."""
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


def _velocity_and_stamp(odometry: Odometry) -> list[float]:
    """Return velocity [m/s] and stamp [s]; the control loop takes no float as a stamp, either."""
    return [*odometry.velocity, WHOLE.of(odometry.stamp_ns, "stamp") * 1e-9]


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


FORMULAS: dict[FormulaName, Callable[[Callable[..., Any]], Any]] = {
    "mean": lambda build: _horizons(build, 0.08, 0.14, 0.05, 0.11, 0.2),
    "hold time": lambda build: _horizons(build, 0.1, hold=0.04),
    "position": partial(_predict, select=lambda o: o.position),
    "orientation": partial(_predict, select=lambda o: o.orientation_wxyz),
    "velocity, stamp": partial(_predict, select=_velocity_and_stamp),
    "P": partial(_command, sign=True, gain_p=(0.5, 1.0, 2.0)),
    "I": partial(_command, n=1000, gain_i=(0.25, 0.25, 0.25)),
    "D": partial(_command, n=9, speed=0.5, gain_d=(0.4, 0.4, 0.4)),
    "limit": partial(_command, velocity_max=(0.3, 0.4, 0.5)),
}
"""Name of a test -> function that returns the results of the plug-in that is built."""


ASKED: dict[FormulaName, str] = {
    "mean": "horizons [s], before the first delay and after each",
    "hold time": "horizons [s] if commands wait in world; use sample.loop_delay",
    "position": "position [m]",
    "orientation": "orientation (wxyz)",
    "velocity, stamp": "velocity [m/s] or stamp [s] (the last number)",
    "P": "velocity [m/s] with P alone",
    "I": "size of the velocity [m/s] with I alone, or after reset()",
    "D": "size of the velocity [m/s] with D alone, or after reset()",
    "limit": "size of the velocity [m/s] at its limit",
}
"""Name of a test -> what it compares, for students."""


def compare(formula: FormulaName, part: str, name: str) -> tuple[float, str]:
    """Return 1.0 and "right" if the student's results agree with those of a correct plug-in.

    Otherwise raise an InvalidValueError. `name` is the plug-in's: the file of the `part`.
    """
    builds = [partial(plugins.load, f"{part}s", name) for name in (name, REFERENCES[part])]
    seen, wanted = (np.asarray(FORMULAS[formula](build), dtype=float) for build in builds)
    if seen.shape == wanted.shape:
        wrong = ~np.isclose(seen, wanted, rtol=0.0, atol=TOLERANCE)
        if not wrong.any():
            return 1.0, "right"
        first = int(np.argwhere(wrong)[0, 0]) if wrong.ndim > 1 else slice(None)
        seen, wanted = seen[first], wanted[first]
    yours, right = seen.round(3).tolist(), wanted.round(3).tolist()
    raise InvalidValueError(f"wrong {ASKED[formula]}: yours {yours}, right {right}")


def check_flights(task: Task, beside: Path) -> None:
    """Check the experiments of a task's flights, their keys and their numbers."""
    for test, experiment in _flights(task, beside):
        if test.number not in map(measure.name_of, experiment.report.metrics):
            measure.find(test.number, look=True)


def needed_files(task: Task, beside: Path) -> set[Path]:
    """Return the lecturer's files that a task's flights need, without those to fill in."""
    found = set[Path]()
    for test, experiment in _flights(task, beside):
        found |= {*map(Path, hash_all(experiment)), *_named_files(test, beside)}
    return found - {beside / name for name in task.files.values()}


def _flights(task: Task, beside: Path) -> Iterator[tuple[TestConfig, ResolvedExperiment]]:
    """Load the experiment of each flight, with those files to fill in that are there."""
    files = {task.key(part): beside / name for part, name in task.files.items()}
    there = {key: file for key, file in files.items() if file.is_file()}
    for part in task.parts.values():
        for test in part.tests.values():
            if test.number:
                yield test, _experiment(test, there, beside)


def _named_files(test: TestConfig, beside: Path) -> Iterator[Path]:
    """Yield the files that a flight's values name, its experiment among them."""
    waiting: list[tuple[Path, Any]] = [(beside, [test.experiment, test.set])]
    file = beside / test.experiment
    if file.is_file():
        waiting.append((file.parent, read_document(file, str(file)).tree))
    while waiting:
        folder, value = waiting.pop()
        if isinstance(value, dict):
            value = [*value.values()]
        if isinstance(value, list):
            waiting += [(folder, each) for each in value]
        elif isinstance(value, str) and os.path.isfile(folder / value):
            yield (folder / value).resolve()


def _experiment(test: TestConfig, own: Mapping[str, Path], beside: Path) -> ResolvedExperiment:
    """Load the experiment of a flight; paths are relative to the folder `beside`."""
    values = dict(test.set)
    for key, value in values.items():
        if isinstance(value, str) and (value.startswith(".") or os.path.isfile(beside / value)):
            values[key] = str(beside / value)
    values |= {key: str(file) for key, file in own.items()}
    file = beside / test.experiment
    name = str(file) if file.is_file() else test.experiment
    return load_experiment(name, [f"{key}={json.dumps(value)}" for key, value in values.items()])


def fly(test: TestConfig, own: Mapping[str, Path], beside: Path) -> tuple[float, str]:
    """Fly a test with the student's files; return the earned share of points [1], and why.

    `own` are the keys of the experiment that get the files.
    """
    experiment = _experiment(test, own, beside)
    code.free_unused()  # the check of the experiment has executed each file once
    found = fly_in_memory(experiment)
    known = found.numbers.get(test.number)
    value = test.none if known is None else known.value
    share = min(max((value - test.none) / (test.full - test.none), 0.0), 1.0)
    seen = f"{test.number} {value:.3g} (all points: {test.full:g}, none: {test.none:g})"
    if share < 1.0:
        seen = f"too {'large' if test.full < test.none else 'small'}: {seen}"
    if failures := found.verdict.failures:
        texts = {failure.code: failure.text for failure in failures}
        share *= 0.0 if "plugin_failed" in texts else FAILED
        why = texts.get("plugin_failed", failures[0].text)
        for key, file in own.items():
            why = why.replace(key, file.name)  # a student knows the file
        seen = f"{why}; {seen}"
    return share, seen


def run(
    task: Task, part: str, folder: Path | None, beside: Path, memory: str = "memory ran out"
) -> Iterator[dict[str, Any]]:
    """Score the tests of a part of a task; yield a row per test, as it ends.

    A test that cannot be scored gives 0. Files of experiments are in the folder `beside`. Without
    a `folder`, score cloudrc's own parts. `memory` is what a lack of memory is called.
    """
    files = task.files
    parts = (part,) if part in files else tuple(files)
    own = {task.key(each): folder / files[each] for each in parts} if folder else {}
    for test in task.parts[part].tests.values():
        try:
            if test.formula:
                name = str(folder / files[part]) if folder else REFERENCES[part]
                share, seen = compare(test.formula, part, name)
            else:
                share, seen = fly(test, own, beside)
        except code.FAILURES as error:
            share, seen = 0.0, _explain(error, folder or beside, files[parts[0]], memory)
        yield {"points": test.points * share, "seen": seen}


def place_of_frame(frame: FrameType, folder: Path) -> str:
    """Return FILE:LINE of the line of the student's files that runs, or has just failed; or ""."""
    trace, error = list[traceback.FrameSummary](), sys.exc_info()[1]
    while error is not None:
        trace += traceback.extract_tb(error.__traceback__)
        error = error.__cause__
    trace += traceback.extract_stack(frame)
    return _place([(each.filename, each.lineno) for each in trace], folder)


def _place(places: Sequence[tuple[str, int | None]], folder: Path) -> str:
    inside = [place for place in places if place[0].startswith(f"{folder}{os.sep}")]
    return f"{Path(inside[-1][0]).relative_to(folder)}:{inside[-1][1]}" if inside else ""


def _explain(error: BaseException, folder: Path, file: str, memory: str) -> str:
    """Describe an error; begin with FILE:LINE, the place in the student's files that failed."""
    while isinstance(error, CloudrcError) and error.__cause__ is not None:
        error = error.__cause__
    told = isinstance(error, CloudrcError | InvalidValueError)
    text = str(error) if told else describe_error(error)
    if isinstance(error, MemoryError):
        text = memory
    trace = traceback.extract_tb(error.__traceback__)
    places = [(each.filename, each.lineno) for each in trace]
    if isinstance(error, SyntaxError):
        places.append((str(error.filename), error.lineno))
    if place := _place(places, folder):
        text = f"{place}: {text}"
    elif not isinstance(error, PlacedError):
        text = f"{file}: {text}"
    return text.replace(f"{folder}{os.sep}", "")
