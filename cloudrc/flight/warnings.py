# SPDX-License-Identifier: Apache-2.0

"""Warn about settings with which a flight is pointless: no packet arrives, or no mission succeeds.

The delays come from a simulation of link and computing time alone: `ages.py`. A warning never
prevents the flight.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from math import ceil, dist, inf

from cloudrc.base.rounding import exceeds
from cloudrc.config.profile import CLOUD_TIME_MAX, COMMAND_AGE_MS, DIRECTIONS
from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.config.scene import has_mujoco
from cloudrc.flight.ages import DURATION_NS, simulate_ages
from cloudrc.flight.assembly.plan import build_plan
from cloudrc.link.doubts import describe_heavy_loss, describe_low_rate
from cloudrc.link.model import HEADER_BYTES
from cloudrc.teleop.wire import Plan
from cloudrc.wire.messages import ZERO, plan_length
from cloudrc.wire.tunnel.codec import COMMAND_SIZES, SCAN_SIZES, TELEMETRY_SIZES

GUARD_STEP = 0.002
"""Time between two looks of the guard at the age of a command [s]."""
WITHOUT_MODEL = (
    "last_sample",
    "commanded_velocity",
    "constant_velocity",
    "constant_acceleration",
)
"""Predictors of cloudrc that know no model of the robot."""


def advise(experiment: ResolvedExperiment) -> list[str]:
    """Return a warning for each group of settings with which the flight is pointless."""
    return list(_advise(experiment))


def _advise(experiment: ResolvedExperiment) -> Iterator[str]:
    plan = build_plan(experiment)
    lost = [
        text for way in DIRECTIONS for text in describe_heavy_loss(getattr(experiment, way), way)
    ]
    slow = list(_low_rates(experiment))
    yield from lost
    yield from _time(experiment, plan)
    yield from _fast_track(experiment, plan) if plan.track else _slow(experiment, plan)
    yield from slow
    cloud = experiment.cloud
    if cloud.send_delta_mps is not None and exceeds(cloud.beat, cloud.plan_s / 4):
        yield (
            f"a plan of {cloud.plan_s:g} s lasts for less than 4 beats of {cloud.beat:g} s, so the "
            "robot holds after a few lost commands; a value that fits: --set "
            f"cloud.beat_s={cloud.plan_s / 4:g}"
        )
    if cloud.controller.name == "mpc" and cloud.predictor.name in WITHOUT_MODEL:
        yield (
            f"the controller mpc plans with the predictor's model, and {cloud.predictor.name} has "
            "none, so the loop may be unstable; a value that fits: --set "
            "cloud.predictor=model_based"
        )
    if not experiment.world.is_nominal and has_mujoco():
        from cloudrc.robots.build import advise as advise_on_robot

        controller = experiment.cloud.controller
        gains = (controller.model_extra or {}).get("gain_p", ZERO)
        yield from advise_on_robot(experiment.world, gains if controller.name == "pid" else ZERO)
    ages, echoes = simulate_ages(experiment)
    if ages and not slow:  # else the queue fills, so the delays depend on the simulated time
        yield from _long_link(experiment, ages, echoes)
    elif not ages and not lost:
        yield (
            f"no command arrives within {DURATION_NS * 1e-9:g} s of its odometry, so the robot "
            "never flies; give shorter delays, in milliseconds"
        )


def _low_rates(experiment: ResolvedExperiment) -> Iterator[str]:
    """Yield a warning for each direction whose bottleneck is slower than its packets need."""
    command = COMMAND_SIZES[plan_length(experiment.cloud.plan_s)]
    robot = experiment.robot
    telemetry, scan = TELEMETRY_SIZES[len(robot.sensors)], robot.scan if experiment.scans else None
    needs = (
        ("uplink", "telemetry", telemetry, experiment.world.odometry_rate_hz),
        ("downlink", "the stream of commands", command, experiment.cloud.command_rate_hz),
    )
    for name, what, size, rate in needs:
        needed = (size + HEADER_BYTES) * 8.0 * rate
        if scan is not None and name == "uplink":
            needed += (SCAN_SIZES[scan.rays] + HEADER_BYTES) * 8.0 * scan.rate_hz
        if name == "uplink" and experiment.camera is not None:
            # Of JPEG the size is not known before.
            needed += experiment.camera.kbit * 1e3 if experiment.camera.codec == "h264" else 0.0
        if doubt := describe_low_rate(getattr(experiment, name), name, needed, what):
            yield doubt


def _time(experiment: ResolvedExperiment, plan: Plan) -> Iterator[str]:
    """Yield a warning if the mission lasts longer than its time limit."""
    limit = experiment.criteria.time_limit_s
    what, lasts = "dwell times", sum(leg.dwell for leg in plan.legs)
    if plan.track:
        what, lasts = "setpoints", plan.track[-1][0]
    if limit is not None and exceeds(lasts, limit):
        yield (
            f"the {what} of the mission last {lasts:,.6g} s, longer than criteria.time_limit_s "
            f"{limit:g}; give times in seconds, or a longer limit"
        )


def _fast_track(experiment: ResolvedExperiment, plan: Plan) -> Iterator[str]:
    """Yield a warning if the setpoints of a file move faster than the robot may."""
    cap = experiment.guard.speed_max_mps
    speeds = [
        (dist(start, position) / (end - begin), begin)
        for (begin, start), (end, position) in pairwise(plan.track)
        if end > begin
    ]
    fastest, begin = max(speeds, default=(0.0, 0.0))
    if exceeds(fastest, cap):
        yield (
            f"the setpoints of mission.setpoints move at {fastest:.3g} m/s after {begin:g} s, and "
            f"the guard caps the speed at {cap:.3g} m/s: the robot falls behind, and the mission "
            "fails if the robot is not at the last row in time"
        )


def _slow(experiment: ResolvedExperiment, plan: Plan) -> Iterator[str]:
    """Yield a warning if the robot may not move fast enough for its waypoints or steps."""
    mission, controller = experiment.mission, experiment.cloud.controller
    settle, legs = experiment.criteria.settle_m or inf, plan.legs
    speeds = {"guard.speed_max_mps": experiment.guard.speed_max_mps}
    own = (controller.model_extra or {}).get("speed_max")
    if controller.name == "pid" and own is not None:
        speeds["cloud.controller.speed_max"] = own
    key = min(speeds, key=lambda name: speeds[name])
    time = dwell = sum(leg.dwell for leg in legs)
    places = [(leg.position, settle if mission.steps else leg.tolerance) for leg in legs]
    if mission.waypoints:
        time = min(plan.time_limit, sum(leg.time_limit for leg in legs)) - dwell
        if mission.start == "spawn":
            places.insert(0, (experiment.scene.spawn, 0.0))
    way = sum(max(0.0, dist(a, b) - near - far) for (a, near), (b, far) in pairwise(places))
    if time > 0 and way > speeds[key] * time:
        yield (
            f"{key} is {speeds[key]:g} m/s, too slow for the {way:.3g} m of the mission's way in "
            f"{time:.4g} s"
        )


def _long_link(
    experiment: ResolvedExperiment, ages: list[float], echoes: list[float]
) -> Iterator[str]:
    """Yield warnings about limits of guard and cloud that are too short for the delays.

    The lists are those of `simulate_ages` [s]. `ages` has the age of the odometry from
    which cloud computed the command that the robot follows. `echoes` has the age of the newest
    command that telemetry has confirmed.
    """
    age_max, cloud = experiment.guard.command_age_max_ms * 1e-3, experiment.cloud
    mean, longest = sum(ages) / len(ages), max(ages)
    lasts = max(age_max, min(ages) + min(cloud.plan_s, experiment.guard.plan_max_s))
    delay = (
        f"commands follow their odometry after {mean * 1e3:.0f} ms on average, after "
        f"{longest * 1e3:.0f} ms at most"
    )
    if min(ages) > age_max or longest > lasts + GUARD_STEP:
        how = "never flies" if min(ages) > age_max else "holds again and again"
        fits = _fit("guard.command_age_max_ms", longest, COMMAND_AGE_MS[1], 1e3)
        why = f"the guard takes commands up to {age_max * 1e3:.0f} ms old"
        yield f"{delay}, and {why}, so the robot {how}; {fits}"
    silence = max(echoes, default=0.0) - min(mean, cloud.horizon_max_s)
    if mean > cloud.horizon_max_s:
        fits = _fit("cloud.horizon_max_s", longest, CLOUD_TIME_MAX)
        yield f"{delay}: more than cloud predicts; {fits}"
    elif silence > cloud.freeze_after_s:
        fits = _fit("cloud.freeze_after_s", silence, CLOUD_TIME_MAX)
        yield f"{delay}, so cloud freezes at times; {fits}"


def _fit(key: str, needed: float, most: float, scale: float = 1.0) -> str:
    """Name a value of `key` above `needed` [s], or say that its largest one, `most`, is too small.

    `scale` is the key's unit per second.
    """
    if needed * scale > most:
        return f"{key} is at most {most:g}"
    value = (ceil(needed * 100) + 1) * 0.01 * scale  # rounded up, with a reserve
    return f"a value that fits: --set {key}={min(round(value, 3), most):g}"
