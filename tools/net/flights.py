# SPDX-License-Identifier: Apache-2.0

"""Flights in virtual time: path, commands, verdict, codes, numbers and records."""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Callable, Mapping
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import cloudrc
from cloudrc import plugins

OWN = Path(__file__).with_name("own")
EXPERIMENTS = "paper", "paper-verbatim", "steps", "hover", "fast"
LINKS = "paper-p1", "paper-p2", "paper-p3", "lossy", "satellite"
SEEDS = 1, 2
ARRAYS = {
    "path": ("/ground_truth", ("stamp_ns", "position", "orientation_wxyz", "velocity")),
    "commands": ("/cmd_vel", ("stamp_ns", "command", "yaw_rate")),
}
"""Name of a hash -> the topic and the columns that it covers."""
STEPS = {"link.profile": "paper-p2", "mission.steps.count": 3}
PID = {"name": "pid", "gain_p": [2.5, 2.5, 2.5]}
SLOW = {"link.uplink.delay_ms": 300, "link.downlink.delay_ms": 300, "guard.command_age_max_ms": 900}
BLIND = {**SLOW, "cloud.plan_s": 0, "cloud.estimator": "split"}
LONG = {"criteria.time_limit_s": 200}
FAR = {"waypoints": [{"position_m": [0, 0, 1]}, {"position_m": [1.5, 0, 1]}], "start": "spawn"}
POINTS: dict[str, tuple[str, dict[str, Any]]] = {
    "robot x2": ("steps", {**STEPS, "world.robot": "x2"}),
    "robot nano": ("fast", {"world.robot": "nano", "mission": "legs"}),
    "robot rover": ("pillars", {}),
    "wind": ("hover", {"world.robot": "nano", "world.wind.velocity_mps": [2, 0]}),
    "plant": ("hover", {"world.plant.mass_factor": 1.05, "world.plant.payload_kg": 0.05}),
    "sensors": ("hover", {"world.sensors.position_noise_m": 0.01}),
    "compute": ("hover", {"cloud.compute_ms": 5}),
    "setpoints": ("hover", {"mission.setpoints": f"{OWN}/setpoints.csv"}),
    "trace": ("steps", {**STEPS, "link.uplink.trace": f"{OWN}/trace.csv"}),
    "own estimator": ("steps", {**STEPS, "cloud.estimator": f"{OWN}/estimator.py"}),
    "own predictor": ("steps", {**STEPS, "cloud.predictor": f"{OWN}/predictor.py"}),
    "own controller": ("steps", {**STEPS, "cloud.controller": f"{OWN}/controller.py"}),
    "own metric": ("steps", {**STEPS, "report.metrics": f"{OWN}/metric.py"}),
    "own onboard": ("steps", {**STEPS, "world.robot": "./robot"}),
    "raising estimator": (
        "steps",
        {**STEPS, "cloud.estimator": {"name": f"{OWN}/estimator.py", "fails": True}},
    ),
    "raising predictor": (
        "steps",
        {**STEPS, "cloud.predictor": {"name": f"{OWN}/predictor.py", "fails": True}},
    ),
    "raising controller": (
        "steps",
        {**STEPS, "cloud.controller": {"name": f"{OWN}/controller.py", "fails": True}},
    ),
    "raising metric": ("steps", {**STEPS, "report.metrics": f"{OWN}/raising_metric.py"}),
    "raising onboard": (
        "steps",
        {**STEPS, "world.robot": "./robot", "world.onboard.fails": True},
    ),
    # One flight per failure code that a flight in virtual time can have.
    "timed_out": ("paper", {"criteria.time_limit_s": 5}),
    "not_started": ("hover", {"link.uplink.loss": 1}),
    "not_touched": ("fast", {"mission": "legs", "mission.touch": {"body": "board"}}),
    "contact_too_fast": ("paper", {"mission.touch.speed_max_mps": 0.05}),
    "not_settled": ("steps", {**STEPS, "criteria.settle_m": 0.001}),
    "unstable": ("hover", {**SLOW, "cloud.controller": PID, "cloud.predictor": "last_sample"}),
    "guard_intervened": (
        "hover",
        {**LONG, "link.downlink.blackouts": [{"start_s": 9, "duration_s": 80}]},
    ),
    "slow": ("hover", {**LONG, "mission": FAR, "guard.speed_max_mps": 0.01}),
    "obstacle_touched": ("fast", {**BLIND, "cloud.predictor": "last_sample"}),
}
"""Name of a flight -> its experiment and settings."""


def facts(result: cloudrc.Result) -> dict[str, Any]:
    """Return what is kept of a flight."""
    hashes = {}
    for name, (topic, columns) in ARRAYS.items():
        digest = hashlib.sha256()
        for column in columns:
            digest.update(result[topic][column].tobytes())
        hashes[name] = digest.hexdigest()
    return {
        "verdict": result.verdict,
        "codes": [failure.code for failure in result.failures],
        **hashes,
        "records": result.records_sha256,
        "numbers": {name: repr(number) for name, number in result.numbers.items()},
        "failures": [failure.text for failure in result.failures],
    }


def fly(
    experiment: str, settings: Mapping[str, Any], seed: int = 1, native: str | None = None
) -> dict[str, Any]:
    """Fly an experiment; `native` is the value of CLOUDRC_NATIVE."""
    if native is not None:
        os.environ["CLOUDRC_NATIVE"] = native
    if settings.get("world.robot") == "./robot":
        own_robot(Path("robot"))
    return facts(cloudrc.fly(experiment, settings, seed=seed))


def own_robot(folder: Path) -> None:
    """Write a robot of a user's: the model of the x2, and the onboard controller of `own`."""
    shutil.copytree(Path(cloudrc.__file__).parent / "robots" / "x2", folder)
    shutil.copy(OWN / "onboard.py", folder)
    (folder / "robot.yaml").write_text("{model: robot.xml, onboard: ./onboard.py, hull_m: 0.34}\n")


def tasks() -> dict[str, Callable[[], Any]]:
    """Return all flights by name."""
    found: dict[str, Callable[[], Any]] = {}
    for experiment, link, seed in product(EXPERIMENTS, LINKS, SEEDS):
        settings = {"link.profile": link}
        found[f"{experiment}/{link}/{seed}"] = partial(fly, experiment, settings, seed)
    for name in plugins.names("estimators"):
        found[f"estimator {name}"] = partial(fly, "steps", {**STEPS, "cloud.estimator": name})
    for name in plugins.names("predictors"):
        found[f"predictor {name}"] = partial(fly, "steps", {**STEPS, "cloud.predictor": name})
    for name, (experiment, settings) in POINTS.items():
        found[name] = partial(fly, experiment, settings)
    for experiment in ("paper", "steps", "fast"):
        found[f"native 0 {experiment}"] = partial(fly, experiment, {}, native="0")
    return found
