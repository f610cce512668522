"""For each key of the schema: a valid value, and the keys that it needs; for generated tests."""

from __future__ import annotations

import json
from typing import Any, Literal, get_args, get_origin

from cloudrc.config import problems
from cloudrc.config.schema import Experiment

LEAVES = {".".join(path): field for path, field in problems.leaves(Experiment)}

SPECIAL: dict[str, Any] = {
    "mission": "hover",
    "mission.waypoints.0.position_m": [0.6, 0.1, 0.8],
    "mission.waypoints.0.yaw_deg": 0,  # the only heading that the onboard controller holds
    "mission.steps.centre_m": [0.1, 0.2, 1.1],
    "mission.steps.range_m": [0.5, 0.5, 0.5],
    "guard.command_age_max_ms": 300,
    "world.robot": "pelican",
    "world.scene": "empty",
    "link.profile": "paper-p3",
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


def valid(key: str) -> Any:
    """Return a valid value of the key, different from its default if possible."""
    if key in SPECIAL:
        return SPECIAL[key]
    field = LEAVES[key]
    if get_origin(field.annotation) is Literal:
        return get_args(field.annotation)[-1]
    words = problems.expectation(Experiment, tuple(key.split(".")))
    if "list of 3" in words:
        return [0.25, 0.5, 0.75]
    if "whole number" in words:
        return 7
    if "number" in words:
        return 0.5
    return (not field.default) if "true or false" in words else "some text"


def beside(key: str) -> list[str]:
    """List the settings that the key needs."""
    above, _, last = key.rpartition(".")
    if above.endswith(".loss") and last in ("loss_bad", "loss_good", "delay_bad_ms"):
        return [f"{above}.bad_start=.1", f"{above}.bad_end=.5", *beside(above)]
    if above.endswith(".loss"):
        other = {"bad_start": "bad_end", "bad_end": "bad_start"}[last]
        return [f"{above}.{other}=.5", *beside(above)]
    if above.endswith("changes.0") and last != "at_s":
        return [f"{above}.at_s=3"]
    if above.endswith("blackouts.0"):
        other = {"start_s": "duration_s", "duration_s": "start_s"}[last]
        return [f"{above}.{other}=2"]
    return []


def base(key: str) -> str:
    """Return the shipped experiment in which to set the key."""
    return "steps" if key == "mission" or key.startswith("mission.steps") else "paper"


def setting(key: str, value: Any) -> str:
    return f"{key}={json.dumps(value)}"
