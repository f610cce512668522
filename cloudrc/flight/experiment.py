# SPDX-License-Identifier: Apache-2.0

"""Load the experiment of a command or of a call, and advise on settings that do not fit."""

from __future__ import annotations

from collections.abc import Iterable

from cloudrc.base.outside.reuse import reuse
from cloudrc.base.requirements import require
from cloudrc.config import overrides
from cloudrc.config.compute import check_unshared
from cloudrc.config.faults import refusal_in
from cloudrc.config.load import load_experiment
from cloudrc.config.overrides import OUTSIDE, Settings, naming_settings, parse_settings
from cloudrc.config.problems import problem_at
from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.config.scene import has_mujoco
from cloudrc.config.schema import Parameters
from cloudrc.config.world import ResolvedWorld
from cloudrc.flight.assembly.sensing import describe_camera
from cloudrc.flight.machine import usable_cores
from cloudrc.flight.pod.transports import find_transport
from cloudrc.flight.warnings import advise
from cloudrc.results.metrics import measure

CORES_OF_ROBOT, CORES_LEFT = 0.22, 0.2
"""What a robot costs in real time, with its cloud and link, and what everything else needs: a cell,
the supervisor [cores]. Source: docs/fleet.md."""
ADVISED_MAX = 50
"""Number of points of a sweep for which warnings are looked for."""
WARNINGS_MAX = 3
"""Largest number of warnings about more than two experiments."""


def load(
    name: str,
    settings: Iterable[str] | Settings,
    seed: int | None = None,
    *,
    fleets: bool = False,
) -> ResolvedExperiment:
    """Load an experiment by name or path with `settings` (KEY=VALUE).

    Check its metrics, and that its robot can move in its scene. Without `fleets`, it must be the
    flight of one robot.
    """
    if not isinstance(settings, dict):
        settings = parse_settings([*settings, *([] if seed is None else [f"seed={seed}"])])
    with naming_settings(settings):
        experiment = load_experiment(name, settings)
        if not fleets:
            check_alone(experiment)
        check_world(experiment.world, turns=experiment.mission.turns)
    own = experiment.report.metrics
    reuse(("metrics", own), lambda: measure.check(own))
    return experiment


def check_no_seed(texts: Iterable[str]) -> None:
    """Check that none of the settings `texts` (KEY=VALUE) is the seed."""
    overrides.check_no_seed(parse_settings(texts))


def robots_of(
    experiment: ResolvedExperiment, name: str, overrides: Iterable[str], seed: int | None = None
) -> list[ResolvedExperiment]:
    """Load the experiment of each robot of a fleet; the other arguments are those of `load`."""
    if experiment.fleet.only is not None:
        return [experiment]
    others = [each for each in overrides if not each.startswith("fleet.only=")]
    numbers = range(experiment.fleet.robots)
    return [load(name, [*others, f"fleet.only={n}"], seed, fleets=True) for n in numbers]


def check_alone(experiment: ResolvedExperiment) -> None:
    """Check that an experiment is the flight of one robot, which needs no cell."""
    if experiment.is_fleet:
        text = "a fleet, or a robot in a cell, flies with `cloudrc run` on this machine only"
        raise problem_at("fleet", f"{text}; fleet.only=0 is its robot 0 alone")


def check_carried(experiment: ResolvedExperiment) -> str:
    """Check that this machine carries the robots of a fleet in real time; tell what they cost."""
    robots = experiment.fleet.robots if experiment.fleet.only is None else 1
    cores, needed = usable_cores(), robots * CORES_OF_ROBOT
    if needed > cores - CORES_LEFT:
        most = int((cores - CORES_LEFT) / CORES_OF_ROBOT)
        text = f"{robots} robots need {needed:.1f} cores in real time, and this machine has {cores}"
        raise problem_at("fleet.robots", f"{text}: fly at most {most}, or with --mode virtual")
    return f"; needs about {needed:.1f} of {cores} cores"


def check_mode(experiment: ResolvedExperiment, mode: str) -> None:
    """Check that an experiment can fly in a mode, before a folder is made.

    `mode` is "virtual", "local" or "cluster".
    """
    if mode == "cluster":
        check_alone(experiment)
    if refused := refusal_in(mode, experiment.faults):
        raise problem_at("faults", refused)
    if mode != "virtual" and (experiment.cloud.clock_offset_s or experiment.cloud.clock_drift_ppm):
        text = "acts, as clock_drift_ppm, in virtual time only; use --mode virtual, or leave it out"
        raise problem_at("cloud.clock_offset_s", text)
    if mode != "cluster":
        describe_camera(experiment)  # else it says what this machine lacks
    if mode != "virtual" and experiment.fleet.robots > 1:
        check_unshared(experiment.cloud)
    if (controller := experiment.cloud.controller.name) in OUTSIDE:
        if mode == "cluster":
            text = f"{controller} flies on this machine only; use --mode virtual or local"
            raise problem_at("cloud.controller", text)
        require("a remote controller", ("policy",))
        find_transport(controller).get("check")()


def check_world(world: ResolvedWorld, *, turns: bool = False) -> None:
    """Check that the robot can move in its scene as `world` says, and with `turns` obeys a yaw.

    The shipped robots can in the shipped scenes, if nothing is changed. Without MuJoCo, such as on
    a machine that only starts flights in a cluster, world checks it.
    """
    shipped = not ("/" in world.robot or world.scene.endswith(".xml"))
    if shipped and world.is_nominal and world.tuning is None and world.onboard == Parameters():
        return
    if not has_mujoco():
        return
    from cloudrc.robots.build import check_robot

    facts = world.model_dump_json(exclude={"sensors", "odometry_rate_hz"})
    reuse(("world", facts, turns), lambda: check_robot(world, turns=turns))


def advice_on(*experiments: ResolvedExperiment) -> list[str]:
    """Return the warnings of `advise`, each once.

    For three or more experiments, such as the points of a sweep, return at most `WARNINGS_MAX`, and
    their number. Of many experiments, about `ADVISED_MAX` are looked at, because each takes some
    milliseconds.
    """
    some = experiments[:: len(experiments) // ADVISED_MAX + 1]
    advice = list(dict.fromkeys(text for each in some for text in advise(each)))
    if len(experiments) > 2 and len(advice) > WARNINGS_MAX:
        advice[WARNINGS_MAX:] = [f"{len(advice)} warnings; the others are alike"]
    return advice
