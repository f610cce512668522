# SPDX-License-Identifier: Apache-2.0

"""Try a plug-in in a flight of some seconds, or an executor in an episode, in virtual time."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from cloudrc.base.outside.values import InvalidValueError
from cloudrc.base.plugins import one
from cloudrc.flight.experiment import load
from cloudrc.flight.in_memory import fly_in_memory
from cloudrc.results.metrics.measure import METRIC_NOTE, find
from cloudrc.results.report.document import Assessment
from cloudrc.results.report.summary import readable

FLIGHTS: dict[str, tuple[str, dict[str, Any], str]] = {
    "estimators": ("steps", {"mission.steps.count": 2}, "delay_estimate_error_rms"),
    "predictors": ("steps", {"mission.steps.count": 2}, "prediction_error_rms"),
    "controllers": ("steps", {"mission.steps.count": 2}, "tracking_rms_measured"),
    "scan": ("gap", {}, "seen_to_acted"),
    "camera": ("follow", {"mission.follow.duration_s": 4}, "seen_to_acted"),
}
"""Kind of plug-in, or what a perception takes -> experiment, settings, and a number to tell."""
LINK = "lte"
"""Profile of the link of these flights and of the episode."""
CHUNK, STEPS = 16, 200
"""Number of actions in an answer, and of steps of an episode."""


def fly(kind: str, name: str, takes: str = "") -> str:
    """Fly with a plug-in of cloud; return a number. `takes` is that of a perception.

    Raise an InvalidValueError if the flight fails.
    """
    experiment, settings, number = FLIGHTS[takes or kind]
    found = _fly(experiment, {**settings, "link.profile": LINK, f"cloud.{one(kind)}": name})
    if found.verdict.failures:
        raise InvalidValueError(found.verdict.failures[0].text)
    return _told(found, number)


def measure(name: str) -> str:
    """Measure a flight with a metric; return the number with its unit.

    Raise an InvalidValueError if there is none.
    """
    metric = find(name).name
    found = _fly("steps", {"mission.steps.count": 2, "report.metrics": [name]})
    for note in found.metric_notes:
        if note.startswith(f"{METRIC_NOTE}{metric} "):
            raise InvalidValueError(note.removeprefix(f"{METRIC_NOTE}{metric} failed: "))
    if metric not in found.numbers:
        return "measure() returned None: this flight has no such number"
    return _told(found, metric)


def play(name: str) -> str:
    """Play an episode with an executor, twice; return how it went.

    Over a link, the policy brings a plant to rest whose state is the sum of its inputs. Raise an
    InvalidValueError if the two differ.
    """
    (states, summary), (again, _) = (_play(name) for _ in range(2))
    if states != again:
        raise InvalidValueError("two equal episodes had different actions")
    age, held = summary["action_age_mean"], summary["held_share"]
    return f"actions are {age * 1e3:.0f} ms old (mean), {held:.0%} of the steps have none"


def _fly(experiment: str, settings: dict[str, Any]) -> Assessment:
    texts = [f"{key}={json.dumps(value)}" for key, value in settings.items()]
    return fly_in_memory(load(experiment, texts))


def _told(found: Assessment, name: str) -> str:
    digits, unit = readable(name, found.numbers[name])
    return f"{name} {digits} {unit}".rstrip()


def _play(name: str) -> tuple[list[float], dict[str, Any]]:
    """Return the states after each step, and the summary of the loop."""
    from cloudrc.gym import Networked
    from cloudrc.gym.linear import Linear

    plant = Linear(A=1.0, W=0.0, x0=1.0, dt=0.02)
    world = Networked(plant, LINK, seed=1, chunk=CHUNK, executor=name)
    seen, _ = world.reset(seed=1)
    states = list[float]()
    for _ in range(STEPS):
        planned = seen[0] * 0.9 ** np.arange(CHUNK)  # the state in the next steps
        seen, *_ = world.step(-0.1 * planned.reshape(CHUNK, 1))
        states.append(float(world.world_info["x"][0]))
    return states, world.summary()
