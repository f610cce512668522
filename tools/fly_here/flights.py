# SPDX-License-Identifier: Apache-2.0

"""Fly what the page "fly it here" shows: each recipe is a link, a predictor and a round trip.

The tracks are small: positions in whole centimetres at 20 Hz, as differences.
"""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Sequence
from itertools import product
from typing import Any, NamedTuple

import numpy as np

import cloudrc
from cloudrc.flight.trials.workers import map_in_order
from cloudrc.physics.geometry.scene import Scene, load_scene
from cloudrc.physics.geometry.tubes import wall
from cloudrc.results.metrics.control import ages_at_actuator
from cloudrc.results.metrics.flight import Array
from cloudrc.results.metrics.verdict import FlightFailure

EXPERIMENT, SCENE, SEED = "fast", "pipes", 4
"""The seed has losses long enough for HOLD while the drone is under way."""
RATE_HZ = 20
"""Positions per second of flight [Hz]."""
RTT_MS = 0, 50, 100, 200, 300, 450, 600
"""Mean round trips, half each way [ms]."""
PREDICTORS = "last_sample", "constant_velocity", "model_based"
LINKS: dict[str, dict[str, Any]] = {
    "steady": {},
    "jittery": {"jitter": 0.4},
    "lossy": {"jitter": 0.1, "loss": {"bad_start": 0.01, "bad_end": 0.05, "loss_bad": 0.8}},
}
"""Link -> its jitter, as a share of the delay [1], and its loss: 13 % in bursts of .2 s."""
FRESH_MS = 200.0
"""What a command may be older than the round trip; the robot holds if it is older [ms]."""


class Recipe(NamedTuple):
    """What tells one flight from the others."""

    link: str
    predictor: str
    rtt_ms: int

    @property
    def settings(self) -> dict[str, Any]:
        """Settings of the experiment, as with `--set`."""
        delay_ms, link = self.rtt_ms / 2, LINKS[self.link]
        return {
            "link.profile": "ideal",
            "link.both.delay_ms": delay_ms,
            "link.both.jitter_ms": delay_ms * link.get("jitter", 0.0),
            "link.both.loss": link.get("loss", 0.0),
            "guard.command_age_max_ms": self.rtt_ms + FRESH_MS,
            "cloud.freeze_after_s": (self.rtt_ms + FRESH_MS) / 1e3,
            "cloud.predictor": self.predictor,
            "cloud.estimator": "split",
            "cloud.plan_s": 0.0,
        }

    @property
    def command(self) -> str:
        """The command that flies it again."""
        words = (f"--set {key}={json.dumps(value)}" for key, value in self.settings.items())
        return f"cloudrc run {EXPERIMENT} --mode virtual --seed {SEED} {' '.join(words)}"


RECIPES = [Recipe(*each) for each in product(LINKS, PREDICTORS, RTT_MS)]


def document(recipes: Sequence[Recipe]) -> dict[str, Any]:
    """Fly all recipes on all cores; return what the page needs, ready for JSON."""
    flights = [*map_in_order(fly, recipes, os.cpu_count() or 1)]
    scene = load_scene(SCENE)
    return {
        "rtt_ms": sorted({each.rtt_ms for each in recipes}),
        "predictors": PREDICTORS,
        "links": [*dict.fromkeys(each.link for each in recipes)],
        "rate_hz": RATE_HZ,
        "outlines": {"above": outlines(scene, 0, 1), "side": outlines(scene, 0, 2)},
        "flights": dict(zip((" ".join(map(str, key)) for key in recipes), flights, strict=True)),
    }


def fly(recipe: Recipe) -> dict[str, Any]:
    """Fly a recipe; return its outcome and its tracks, in the units of `track`."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that the mission may not succeed over this link
        result = cloudrc.fly(EXPERIMENT, recipe.settings, seed=SEED)
    flight, failures = result.flight, result.failures
    end = (failures and failures[0].time) or flight.duration
    at_ns = (flight.mission_ns or 0) + np.arange(0.0, end, 1 / RATE_HZ) * 1e9
    applied = flight.applied
    row = np.maximum(applied["stamp_ns"].searchsorted(at_ns, "right") - 1, 0)
    return {
        "command": recipe.command,
        "verdict": result.verdict,
        "text": told(failures[0]) if failures else "",
        "end": round(end, 1),
        "error_mm": round(1e3 * result.numbers["prediction_error_rms"], 1),
        "robot": track(flight.true_position(at_ns)),
        "cloud": track(applied["position"][row]),
        "age": ages(result, at_ns),
    }


def told(failure: FlightFailure) -> str:
    """Say why a flight failed, for readers who do not know the keys of experiments."""
    if failure.code == "contact_too_fast":
        return "it hit the board too fast"
    return failure.text.partition(" (")[0].replace("the robot", "it")


def track(positions: Array) -> list[list[int]]:
    """Return x, y and z [cm] of positions [m], shape (n, 3): the first, then the differences."""
    whole = np.rint(100 * positions).astype(int)
    return np.diff(whole, axis=0, prepend=0).T.tolist()


def ages(result: cloudrc.Result, at_ns: Array) -> list[int]:
    """Return the age of what the robot acts on at instants [10 ms]; -1: no command is in use."""
    pieces = ages_at_actuator(result.flight)
    row = np.maximum(pieces.begin_ns.searchsorted(at_ns, "right") - 1, 0)
    since = (at_ns - pieces.begin_ns[row]) * 1e-9
    is_used = (since >= 0) & (since <= pieces.high[row] - pieces.low[row])
    return np.where(is_used, np.rint(100 * (pieces.low[row] + since)), -1).astype(int).tolist()


def outlines(scene: Scene, across: int, up: int) -> list[list[list[float]]]:
    """Return the corners of each obstacle, seen along one axis [m]: its convex hull."""
    bodies = [wall(tube, (0.0,) * 4).corners for tube in scene.tubes]
    for plate in scene.plates:
        corners = product((plate.x, plate.x + 0.05), plate.y, plate.z)
        bodies.append(np.array([*corners]))
    return [hull(body[:, [across, up]]) for body in bodies]


def hull(points: Array) -> list[list[float]]:
    """Return the convex hull of points, shape (n, 2): its corners, counter-clockwise.

    Source: A. M. Andrew, "Another efficient algorithm for convex hulls in two dimensions",
    Information Processing Letters 9 (5), 1979.
    """
    ordered = np.unique(np.round(points, 2), axis=0)
    found: list[list[float]] = []
    for half in (ordered, ordered[::-1]):
        begin = len(found)
        for point in half.tolist():
            while len(found) > begin + 1 and _turns_right(found[-2], found[-1], point):
                found.pop()
            found.append(point)
        found.pop()
    return found


def _turns_right(a: list[float], b: list[float], c: list[float]) -> bool:
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]) <= 0
