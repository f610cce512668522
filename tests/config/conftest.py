"""Helpers for each key of the schema: a valid value, and other settings that the key needs."""

import json
from typing import Literal, get_args, get_origin

import pytest

from cloudrc.config import problems
from cloudrc.config.load import load_experiment
from cloudrc.config.schema import Experiment
from cloudrc.errors import BadInputError

LEAVES = {".".join(path): field for path, field in problems.leaves(Experiment)}
SPECIAL = {
    "mission": "hover",
    "mission.waypoints.0.position_m": [0.6, 0.1, 0.8],
    "mission.waypoints.0.yaw_deg": 0,  # the only heading that the onboard controller holds
    "mission.steps.centre_m": [0.1, 0.2, 1.1],
    "mission.steps.range_m": [0.5, 0.5, 0.5],
    "guard.command_age_max_ms": 300,
    "cloud.command_rate_hz": 50,
    "world.robot": "pelican",
    "world.scene": "empty",
    "link.profile": "paper-p3",
    "mission.setpoints": None,
    **{f"link.{way}link.{key}": None for way in ("up", "down") for key in ("trace", "table")},
    **{f"link.{way}link.distribution": "pareto" for way in ("up", "down")},
    "cloud.estimator": "split",
    "cloud.estimator.name": "ewma",
    "cloud.predictor": "last_sample",
    "cloud.predictor.name": "last_sample",
    "cloud.controller": "pid",
    "cloud.controller.name": "pid",
    "report.metrics": ["duration"],
}


def refused(name, *settings):
    """Return the error message of an invalid experiment."""
    with pytest.raises(BadInputError) as caught:
        load_experiment(str(name), settings)
    assert caught.value.exit_code == 2
    return str(caught.value)


def words(key):
    return problems.expectation(Experiment, tuple(key.split(".")))


def valid(key):
    """Return a valid value of the key, different from its default if possible."""
    if key in SPECIAL:
        return SPECIAL[key]
    field = LEAVES[key]
    if get_origin(field.annotation) is Literal:
        return get_args(field.annotation)[-1]
    known = {"list of 2": [0.25, 0.5], "list of 3": [0.25, 0.5, 0.75],
             "list of 4": [1.0, 0.5, 0.75, 2.0], "whole number": 7, "number": 0.5,
             "true or false": not field.default}  # fmt: skip
    return next((value for word, value in known.items() if word in words(key)), "some text")


def beside(key):
    """List the settings that the key needs."""
    above, _, last = key.rpartition(".")
    if key == "cloud.plan_s":
        return ["cloud.predictor=model_based"]
    if key == "mission.waypoints.0.speed_mps":
        return ["mission.carrot={}"]
    if above.endswith(".loss"):
        needed = {"bad_start": 0.1, "bad_end": 0.5}
        found = [f"{above}.{name}={value}" for name, value in needed.items() if name != last]
        return [*found, *beside(above)]
    if last == "compute_deviation_ms":
        return ["cloud.compute_ms=5"]
    if above.endswith("changes.0") and last != "at_s":
        return [f"{above}.at_s=3"]
    if above.endswith("blackouts.0"):
        other = {"start_s": "duration_s", "duration_s": "start_s"}[last]
        return [f"{above}.{other}=2"]
    return []


def base(key):
    """Return the shipped experiment in which to set the key."""
    return "steps" if key == "mission" or key.startswith("mission.steps") else "paper"


def setting(key, value):
    return f"{key}={json.dumps(value)}"
