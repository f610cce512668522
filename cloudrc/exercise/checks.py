"""Score the exercise of docs/exercise.md: formulas on given samples, then flights in virtual time.

The exercise has three parts: estimator, predictor and controller. The reference is cloudrc's own
plug-ins. A flight that scores one part uses the reference for the other two parts, so that an error
in one part costs no points of another part. All flights and all points are computed here, in the
process of the check; the student's functions run in another process (`hand_in`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cloudrc import plugins
from cloudrc.cloud.estimators import DelaySample
from cloudrc.cloud.loop import ControlLoop
from cloudrc.config.load import load_experiment
from cloudrc.errors import describe_error, machine_error, to_one_line
from cloudrc.exercise.hand_in import FILES, find_method
from cloudrc.exercise.remote import HandInError, Remote
from cloudrc.messages import UPRIGHT, ZERO, Odometry, Setpoint
from cloudrc.outside.values import WHOLE, InvalidValueError
from cloudrc.runs.flight import fly_in_memory

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


class Formula(NamedTuple):
    """A test that compares the results of the student's plug-in with those of a correct plug-in."""

    test: str
    points: int
    measure: Callable[[Callable[..., Any]], Any]

    def score(self, parts: Sequence[str], hand_in: Remote) -> tuple[float, str]:
        """Return 1.0 and "right" if the student's results agree with those of the reference.

        Otherwise raise an InvalidValueError. `parts` has one entry.
        """
        (part,) = parts
        reference = partial(plugins.load, f"{part}s", REFERENCES[part])
        builds = partial(hand_in.build, part), reference
        seen, wanted = (np.asarray(self.measure(build), dtype=float) for build in builds)
        if seen.shape == wanted.shape:
            wrong = ~np.isclose(seen, wanted, rtol=0.0, atol=TOLERANCE)
            if not wrong.any():
                return 1.0, "right"
            first = int(np.argwhere(wrong)[0, 0]) if wrong.ndim > 1 else slice(None)
            seen, wanted = seen[first], wanted[first]
        raise InvalidValueError(f"gives {seen.round(3).tolist()}, not {wanted.round(3).tolist()}")


class Exam(NamedTuple):
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

    def score(self, parts: Sequence[str], hand_in: Remote) -> tuple[float, str]:
        """Fly with the student's `parts`; return the earned share of points [1], and why."""

        def make_loop(*own: Any, **limits: Any) -> ControlLoop:
            plug_ins = dict(zip(REFERENCES, own, strict=True))
            for part in parts:
                build = partial(hand_in.build, part)
                plug_ins[part] = build if part == "estimator" else build()
            return ControlLoop(*plug_ins.values(), **limits)

        experiment = load_experiment(self.experiment, [f"link.profile={self.link}"])
        found = fly_in_memory(experiment, make_loop)
        known = found.numbers.get(self.metric)
        value = self.none if known is None else known.value
        share = min(max((value - self.none) / (self.full - self.none), 0.0), 1.0)
        seen = f"{self.metric} {value:.3g} (all points: {self.full:g}, none: {self.none:g})"
        if failures := found.verdict.failures:
            texts = {failure.code: failure.text for failure in failures}
            share *= 0.0 if "plugin_failed" in texts else FAILED
            seen += f"; {texts.get('plugin_failed', failures[0].text)}"
        return share, seen


CHECKS: dict[str, tuple[Formula | Exam, ...]] = {
    "estimator": (
        Formula("mean", 10, lambda build: _horizons(build, 0.08, 0.14, 0.05, 0.11, 0.2)),
        Formula("hold time", 5, lambda build: _horizons(build, 0.1, hold=0.04)),
        Exam("steps", 10, "steps", "paper-p3", "delay_estimate_error_rms", 0.025, 0.06),
    ),
    "predictor": (
        Formula("position", 6, partial(_predict, select=lambda o: o.position)),
        Formula("orientation", 5, partial(_predict, select=lambda o: o.orientation_wxyz)),
        Formula("velocity, stamp", 4, partial(_predict, select=_velocity_and_stamp)),
        Exam("steps", 10, "steps", "paper-p3", "prediction_error_rms", 0.015, 0.04),
    ),
    "controller": (
        Formula("P", 5, partial(_command, sign=True, gain_p=(0.5, 1.0, 2.0))),
        Formula("I", 4, partial(_command, n=1000, gain_i=(0.25, 0.25, 0.25))),
        Formula("D", 3, partial(_command, n=9, speed=0.5, gain_d=(0.4, 0.4, 0.4))),
        Formula("limit", 3, partial(_command, velocity_max=(0.3, 0.4, 0.5))),
        Exam("steps", 10, "steps", "paper-p3", "iae_mean", 1.8, 4.0),
    ),
    "together": (
        Exam("paper, paper-p2", 10, "paper", "paper-p2", "waypoints_reached", 7, 0),
        Exam("paper, satellite", 15, "paper", "satellite", "waypoints_reached", 7, 0),
    ),
}
"""Part, or all parts together -> its checks; 100 points in total."""


def run(part: str, hand_in: Remote, folder: Path) -> Iterator[dict[str, Any]]:
    """Score the tests of a part, or of all "together"; yield a row per test, as it ends.

    `hand_in` calls the functions of the files in `folder`. A test that cannot be scored gives 0.
    """
    parts = tuple(FILES) if part == "together" else (part,)
    for check in CHECKS[part]:
        try:
            share, seen = check.score(parts, hand_in)
        except HandInError as error:
            share, seen = 0.0, str(error)
        except Exception as error:  # the answers may be anything
            if failure := machine_error(error):
                raise failure from error
            text = str(error) if isinstance(error, InvalidValueError) else describe_error(error)
            share, seen = 0.0, f"{find_method(folder, parts[0])}: {text}"
        yield {
            "part": part,
            "test": check.test,
            "points": round(check.points * min(max(share, 0.0), 1.0), 1),
            "max_points": check.points,
            "seen": to_one_line(seen),
        }
