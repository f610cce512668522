# SPDX-License-Identifier: Apache-2.0

"""The contract of each kind of plug-in, on samples that are made here.

Each check raises an InvalidValueError that says what is wrong. A plug-in of cloudrc is held to more
by tests/cloud/test_conformance.py.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from math import inf, pi
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cloudrc.base.outside.values import RESULT, InvalidValueError
from cloudrc.cloud.estimators import DelaySample
from cloudrc.cloud.perceiving import judge
from cloudrc.cloud.perceptions import Frame, Scan
from cloudrc.cloud.results import check_estimate, check_output
from cloudrc.wire.messages import Command, Odometry, Setpoint

Build = Callable[[], Any]
"""Builds a plug-in anew, with its default parameters."""
Check = tuple[str, Callable[[Build], None]]
"""What a check holds, in words, and the check."""
PERIOD_NS = 10_000_000
"""Time between two samples [ns]."""
FAR = (-inf, -inf, -inf), (inf, inf, inf)
"""A fence that changes no setpoint [m]."""


def samples(count: int, start_ns: int = 10**9) -> list[Odometry]:
    """Return odometry on a curve, from `start_ns` [ns] on: the robot is tilted, and turns."""
    return [
        Odometry(
            start_ns + k * PERIOD_NS,
            (0.01 * k, -0.02 * k, 1.0),
            (0.8, 0.0, 0.0, 0.6),
            (1.0, -2.0 + 0.1 * k, 0.1),
            (0.3, -0.2, 0.8),
        )
        for k in range(count)
    ]


def _hold(condition: bool, text: str) -> None:
    if not condition:
        raise InvalidValueError(text)


def _first_horizon_is_zero(build: Build) -> None:
    horizon = RESULT.of(build().horizon(7.0), "horizon")
    _hold(horizon == 0.0, f"before the first sample, horizon() returned {horizon:g} s, not 0")


def _horizons_are_finite(build: Build) -> None:
    estimator = build()
    for delay in (0.1, 0.02, 0.9, 0.3, 0.3, 0.0):
        estimator.update(DelaySample(delay, 0.9 * delay))
        estimator.add_applied(0.5 * delay - 3.0)
        horizon = RESULT.of(estimator.horizon(3.0 + 0.5 * delay), "horizon")
        _hold(horizon >= 0.0, f"horizon() returned {horizon:g} s, which is negative")


def _observed(build: Build) -> tuple[Any, Odometry]:
    """Return a predictor that has seen a session, and the newest sample."""
    predictor = build()
    for k, sample in enumerate(samples(20)):
        predictor.observe(sample)
        stamp_ns = k * PERIOD_NS
        predictor.commanded(Command(stamp_ns, sample.stamp_ns, 0, (1.0, 0.5, 0.1), 0.2))
        predictor.applied(stamp_ns, sample.stamp_ns)
    return predictor, sample


def _no_horizon_changes_nothing(build: Build) -> None:
    predictor, sample = _observed(build)
    found = predictor.predict(sample, 0.0)
    _hold(found == sample, "with a horizon of 0, predict() did not return the sample")


def _predictions_are_states(build: Build) -> None:
    predictor, sample = _observed(build)
    for horizon in (0.01, 0.1, 0.5, 1.0):
        found = check_estimate(predictor.predict(sample, horizon))
        later = (found.stamp_ns - sample.stamp_ns) * 1e-9
        _hold(
            abs(later - horizon) < 1e-6,
            f"with a horizon of {horizon} s, the stamp is {later:g} s later: add it to stamp_ns",
        )


def _predictions_repeat(build: Build) -> None:
    predictor, sample = _observed(build)
    first, again = (predictor.predict(sample, 0.2) for _ in range(2))
    _hold(first == again, "two equal calls of predict() gave different results")


def _a_predictor_forgets(build: Build) -> None:
    used, _ = _observed(build)
    fresh = build()
    used.reset()
    for sample in samples(5, start_ns=0):  # a new session may begin earlier
        used.observe(sample)
        fresh.observe(sample)
        same = used.predict(sample, 0.1) == fresh.predict(sample, 0.1)
        _hold(same, "after reset(), predict() still depends on the session before")


def _commands(controller: Any, setpoint: Setpoint, states: Iterable[Odometry]) -> list[Any]:
    made = [controller.update(state, setpoint, 0.01) for state in states]
    return [None if each is None else check_output(each) for each in made]


def _commands_are_finite(build: Build) -> None:
    controller = build()
    for goal in ((0.0, 0.0, 1.0), (100.0, -50.0, 20.0)):
        _commands(controller, Setpoint(goal, yaw=1.0, turns=True), samples(20))


def _a_controller_forgets(build: Build) -> None:
    used, fresh = build(), build()
    _commands(used, Setpoint((3.0, 2.0, 1.0)), samples(50))
    used.reset()
    after = (_commands(each, Setpoint((-1.0, 2.0, 0.5)), samples(3)) for each in (used, fresh))
    first, again = after
    _hold(first == again, "after reset(), update() still depends on the mission before")


def seen_by(takes: str, count: int) -> list[Scan | Frame]:
    """Return what a perception gets that `takes` "scan" or "camera"."""
    stamps_ns = [sample.stamp_ns for sample in samples(count)]
    if takes == "scan":
        angles = np.linspace(-0.75 * pi, 0.75 * pi, 181)
        rooms = [2.0 + np.cos(3.0 * angles + k) for k in range(count)]
        rooms[-1] = np.full(angles.shape, inf)  # nothing within range
        return [Scan(*each, angles) for each in zip(stamps_ns, rooms, strict=True)]
    if takes != "camera":
        raise InvalidValueError(f"takes is {takes!r}; it must be scan or camera")
    images = [np.full((60, 80, 3), 90, np.uint8) for _ in range(count)]
    for k, image in enumerate(images[:-1]):
        image[20:40, 10 + k : 40 + k] = 230, 26, 20
    return [
        Frame(ns, k, image, 1.0)
        for k, (ns, image) in enumerate(zip(stamps_ns, images, strict=True))
    ]


def _setpoints(perception: Any, seen: Iterable[Scan | Frame]) -> list[Setpoint | None]:
    made = [perception.see(*each) for each in zip(seen, samples(10), strict=False)]
    return [None if each is None else judge(each, *FAR) for each in made]


def _setpoints_are_finite(build: Build) -> None:
    perception = build()
    _setpoints(perception, seen_by(perception.takes, 10))


def _what_is_seen_stays(build: Build) -> None:
    perception = build()
    seen, copies = (seen_by(perception.takes, 3) for _ in range(2))
    _setpoints(perception, seen)
    for each, before in zip(seen, copies, strict=True):
        same = np.array_equal(_values(each), _values(before))
        _hold(same, "see() changed what it was given, which others use, too; copy it first")


def _values(seen: Scan | Frame) -> NDArray[Any]:
    return seen.ranges if isinstance(seen, Scan) else seen.image


def _equal_looks_are_equal(build: Build) -> None:
    first, again = (_setpoints(each, seen_by(each.takes, 10)) for each in (build(), build()))
    _hold(first == again, "two equal looks gave different setpoints")


def _a_perception_forgets(build: Build) -> None:
    used, fresh = build(), build()
    _setpoints(used, seen_by(used.takes, 10))
    used.reset()
    first, again = (_setpoints(each, seen_by(each.takes, 4)) for each in (used, fresh))
    _hold(first == again, "after reset(), see() still depends on the mission before")


CHECKS: dict[str, list[Check]] = {
    "estimators": [
        ("the horizon is 0 before the first sample", _first_horizon_is_zero),
        ("horizons are finite, and not negative", _horizons_are_finite),
    ],
    "predictors": [
        ("a horizon of 0 gives the sample back", _no_horizon_changes_nothing),
        ("predictions are finite, later by the horizon, and rotations", _predictions_are_states),
        ("equal calls give equal predictions", _predictions_repeat),
        ("reset() forgets the session before", _a_predictor_forgets),
    ],
    "controllers": [
        ("commands are finite", _commands_are_finite),
        ("reset() forgets the mission before", _a_controller_forgets),
    ],
    "perceptions": [
        ("setpoints are finite", _setpoints_are_finite),
        ("what it sees stays as it is", _what_is_seen_stays),
        ("equal looks give equal setpoints", _equal_looks_are_equal),
        ("reset() forgets the mission before", _a_perception_forgets),
    ],
}
"""Kind of plug-in -> its checks. Those of an executor and a metric need an episode or a flight."""
