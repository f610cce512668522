"""Warn about settings that do not fit together, and suggest a value that fits.

The delays come from a simulation of link and computing time alone: `ages.py`. A warning never
prevents the flight.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import pairwise
from math import ceil, dist, floor
from typing import TYPE_CHECKING, Any

from cloudrc.config.scene import has_mujoco
from cloudrc.outside.reuse import reuse_results
from cloudrc.rounding import exceeds, format_limit

if TYPE_CHECKING:
    from cloudrc.config.resolved import ResolvedExperiment
    from cloudrc.link.profile import DirectionProfile

GUARD_STEP = 0.002
"""Time between two looks of the guard at the age of a command [s]."""


FITTED = "command_history", "kalman", "model_based"
"""Predictors that use the response of a robot that has no better model."""


@reuse_results()  # ten checks look at the file of the robot
def advise(experiment: ResolvedExperiment) -> list[str]:
    """Return a warning for each group of settings that do not fit together."""
    return list(_advise(experiment))


def _advise(experiment: ResolvedExperiment) -> Iterator[str]:
    from cloudrc.ages import simulate_ages

    ways = _directions(experiment)
    yield from _units(ways)
    yield from _time(experiment)
    yield from _slow(experiment)
    yield from _tuning(experiment)
    yield from _balance(experiment)
    carrot, cap = experiment.mission.carrot, experiment.guard.speed_max_mps
    if carrot is not None and exceeds(carrot.speed_mps, cap):
        fits = f"--set mission.carrot.speed_mps={_round_down(cap)}"
        yield (
            f"the carrot moves at {cap:.3g} instead of {carrot.speed_mps:g} m/s, because the guard "
            f"caps the speed; a value that fits: {fits}"
        )
    yield from _fast_track(experiment)
    ages, echoes = simulate_ages(experiment)
    low_rates = list(_low_rates(experiment))
    yield from low_rates
    if not ages:
        yield from _late(ways)
    elif not low_rates:  # else the queue fills, so the delays depend on the simulated time
        yield from _long_link(experiment, ages, echoes)
        yield from _control(experiment, sum(ages) / len(ages))


def _units(ways: Mapping[str, DirectionProfile]) -> Iterator[str]:
    """Yield a warning for each direction in which no packet arrives."""
    from cloudrc.link.doubts import describe_heavy_loss

    for name, profile in ways.items():
        yield from describe_heavy_loss(profile, name)


def _directions(experiment: ResolvedExperiment) -> dict[str, DirectionProfile]:
    """Return name -> profile of both directions of the link, with the contents of their files."""
    from cloudrc.link.traces import link_profile

    return {way: link_profile(getattr(experiment, way)) for way in ("uplink", "downlink")}


def _low_rates(experiment: ResolvedExperiment) -> Iterator[str]:
    """Yield a warning for each direction whose bottleneck is slower than its packets need."""
    from cloudrc.config.robot import known_robot
    from cloudrc.link.doubts import describe_low_rate
    from cloudrc.link.model import HEADER_BYTES
    from cloudrc.messages import plan_length
    from cloudrc.tunnel.codec import COMMAND_SIZES, TELEMETRY_SIZES

    command = COMMAND_SIZES[plan_length(experiment.cloud.plan_s)]
    telemetry = TELEMETRY_SIZES[len(known_robot(experiment.world.robot).sensors)]
    needs = (
        ("uplink", "telemetry", telemetry, experiment.world.odometry_rate_hz),
        ("downlink", "the stream of commands", command, experiment.cloud.command_rate_hz),
    )
    for name, what, size, rate in needs:
        needed = (size + HEADER_BYTES) * 8.0 * rate
        if doubt := describe_low_rate(getattr(experiment, name), name, needed, what):
            yield doubt


def _late(ways: Mapping[str, DirectionProfile]) -> Iterator[str]:
    """Yield a warning if delays are the reason why no command arrives in the simulated time."""
    from cloudrc.ages import DURATION_NS
    from cloudrc.config.profile import COMMAND_AGE_MS
    from cloudrc.link.profile import Timeline

    parts, total = list[str](), 0.0
    for name, profile in ways.items():
        delay = min(piece.delay_ns for piece in Timeline(profile).pieces) * 1e-9
        total += delay
        if delay >= 1.0:
            value = f"delay_ms is {delay * 1e3:g} ({delay:g} s)"
            if profile.rows:
                value = f"trace has delays from {delay:g} s"
            parts.append(f"link.{name}.{value}")
    if total >= COMMAND_AGE_MS[1] * 1e-3:
        yield (
            f"{' and '.join(parts)}: no command arrives within {DURATION_NS * 1e-9:g} s of its "
            "odometry, so the robot never flies; give delays in milliseconds"
        )


def _time(experiment: ResolvedExperiment) -> Iterator[str]:
    """Yield a warning if the mission lasts longer than its time limit."""
    from cloudrc.assembly import build_plan
    from cloudrc.config.schema import DURATION_MAX

    mission, plan = experiment.mission, build_plan(experiment)
    if plan.track:
        what, lasts = "the setpoints of mission.setpoints last", plan.track[-1][0]
    else:
        what, lasts = (
            "the dwell times of the mission add up to",
            sum(leg.dwell for leg in plan.legs),
        )
        if mission.steps:
            what = "the steps of mission.steps last"
    limit = experiment.criteria.time_limit_s
    longer = min(ceil(1.2 * lasts), DURATION_MAX)
    if limit is not None and exceeds(lasts, limit):
        yield (
            f"{what} {lasts:,.6g} s, longer than criteria.time_limit_s {format_limit(limit)}; give"
            f" times in seconds, or a longer limit: --set criteria.time_limit_s={longer}"
        )


def _fast_track(experiment: ResolvedExperiment) -> Iterator[str]:
    """Yield a warning if the setpoints of a file move faster than the robot may."""
    from cloudrc.assembly import build_plan

    track, cap = build_plan(experiment).track, experiment.guard.speed_max_mps
    speeds = [
        (dist(start, position) / (end - begin), begin)
        for (begin, start), (end, position) in pairwise(track)
        if end > begin
    ]
    fastest, begin = max(speeds, default=(0.0, 0.0))
    if exceeds(fastest, cap):
        yield (
            f"the setpoints of mission.setpoints move at {fastest:.3g} m/s after {begin:g} s, and "
            f"the guard caps the speed at {cap:.3g} m/s: the robot falls behind, and the mission "
            "fails if the robot is not at the last row in time"
        )


def _slow(experiment: ResolvedExperiment) -> Iterator[str]:
    """Yield a warning if the robot may not move fast enough for its waypoints or steps."""
    from cloudrc.assembly import build_plan
    from cloudrc.config.scene import scene_of

    mission, controller = experiment.mission, experiment.cloud.controller
    plan, settle = build_plan(experiment), experiment.criteria.settle_m
    if not plan.legs or plan.track or (mission.steps and settle is None):
        return
    speeds = {"guard.speed_max_mps": experiment.guard.speed_max_mps}
    own = (controller.model_extra or {}).get("speed_max")
    if controller.name == "pid" and own is not None:
        speeds["cloud.controller.speed_max"] = own
    key = min(speeds, key=lambda name: speeds[name])
    dwell = sum(leg.dwell for leg in plan.legs)
    time = min(plan.time_limit, sum(leg.time_limit for leg in plan.legs)) - dwell
    if mission.steps:
        time = dwell
    way, first = 0.0, plan.legs[0]
    if mission.waypoints and mission.start == "spawn":
        spawn = scene_of(experiment.world).spawn
        way = max(0.0, dist(spawn, first.position) - first.tolerance)
    for before, leg in pairwise(plan.legs):
        near = 2 * settle if mission.steps and settle else before.tolerance + leg.tolerance
        way += max(0.0, dist(before.position, leg.position) - near)
    if time > 0 and way > speeds[key] * time:
        yield (
            f"{key} is {speeds[key]:g} m/s, too slow for the {way:.3g} m of the "
            f"mission's way in {time:.4g} s; a value that fits: "
            f"--set {key}={_round_up(2 * way / time, 0.01):g}"
        )


def _tuning(experiment: ResolvedExperiment) -> Iterator[str]:
    """Yield a warning if a predictor uses the response of the robot without its tuning."""
    from cloudrc.config.robot import known_robot

    name, predictor = experiment.world.tuning, experiment.cloud.predictor
    robot, given = known_robot(experiment.world.robot), predictor.model_extra or {}
    own = given.get("model_file", given.get("model"))  # a file of `cloudrc identify`
    if name in {None, *robot.responses} or robot.motion or predictor.name not in FITTED or own:
        return
    yield (
        f"{predictor.name} predicts with the response of {experiment.world.robot} without the "
        f"tuning {name}; fly steps with the tuning, fit them with 'cloudrc identify', and write "
        f"the result to tunings.{name}.response in its robot.yaml"
    )


def _balance(experiment: ResolvedExperiment) -> Iterator[str]:
    """Yield the warnings of the onboard controller about a world that differs from its model.

    Without MuJoCo there are none, because the controller's plug-in may need it.
    """
    if experiment.world.is_nominal or not has_mujoco():
        return
    controller = experiment.cloud.controller
    gains = (controller.model_extra or {})["gain_p"] if controller.name == "pid" else (0.0, 0, 0.0)
    from cloudrc.robots.build import advise as advise_on_robot

    yield from advise_on_robot(experiment.world, gains)


def _long_link(
    experiment: ResolvedExperiment, ages: list[float], echoes: list[float]
) -> Iterator[str]:
    """Yield warnings about limits of guard and cloud that are too short for the delays.

    The lists are those of `simulate_ages` [s]. `ages` has the age of the odometry from
    which cloud computed the command that the robot follows. `echoes` has the age of the newest
    command that telemetry has confirmed.
    """
    from cloudrc.config.profile import CLOUD_TIME_MAX, COMMAND_AGE_MS

    age_max, cloud = experiment.guard.command_age_max_ms * 1e-3, experiment.cloud
    mean, longest = sum(ages) / len(ages), max(ages)
    lasts = max(age_max, min(ages) + min(cloud.plan_s, experiment.guard.plan_max_s))
    delay = f"commands follow their odometry after {mean * 1e3:.0f} ms on average"
    if min(ages) > age_max or longest > lasts + GUARD_STEP:
        how = "never flies" if min(ages) > age_max else "holds again and again"
        yield (
            f"{delay}, after {longest * 1e3:.0f} ms at most, and the guard refuses commands after "
            f"{age_max * 1e3:.0f} ms, so the robot {how}; "
            + _fit("guard.command_age_max_ms", longest, 0.01, COMMAND_AGE_MS[1], 1e3)
        )
    silence = max(echoes, default=0.0) - min(mean, cloud.horizon_max_s)
    if mean > cloud.horizon_max_s:
        fits = _fit("cloud.horizon_max_s", longest, 0.1, CLOUD_TIME_MAX)
        yield f"{delay}, which is more than cloud predicts; {fits}"
    elif silence > cloud.freeze_after_s:
        fits = _fit("cloud.freeze_after_s", silence, 0.1, CLOUD_TIME_MAX)
        yield f"{delay}, and cloud freezes at times; {fits}"


def _fit(key: str, needed: float, step: float, most: float, scale: float = 1.0) -> str:
    """Name a value of `key` above `needed` [s], or say that its largest one, `most`, is too small.

    `step` is that of `_round_up` [s], `scale` the key's unit per second.
    """
    if needed * scale > most:
        return f"{key} is at most {most:g}"
    return f"a value that fits: --set {key}={min(_round_up(needed, step) * scale, most):g}"


def _round_up(value: float, step: float) -> float:
    """Round a value up to a multiple of `step`, and add one more step as a reserve."""
    return round((ceil(value / step) + 1) * step, 3)


def _round_down(speed: float) -> str:
    """Format a speed [m/s] with two decimals, not above it."""
    return f"{floor(speed * 100) / 100:g}"


def _control(experiment: ResolvedExperiment, delay: float) -> Iterator[str]:
    """Yield advice about the PID's gains; `delay` is the mean time from odometry to command [s]."""
    controller = experiment.cloud.controller
    if controller.name != "pid":
        return
    values: dict[str, Any] = controller.model_extra or {}
    cap, speed_max = experiment.guard.speed_max_mps, values["speed_max"]
    winds_up = values["integral_limit"] is None and (speed_max is None or speed_max > cap)
    if any(values["gain_i"]) and winds_up:
        yield (
            f"cloud.controller integrates while the guard caps the speed at {cap:.3g} m/s; "
            f"a value that fits: --set cloud.controller.speed_max={_round_down(cap)}"
        )
    gain = max(values["gain_p"])
    if experiment.cloud.predictor.name == "commanded_velocity" and gain * delay > 1.0:
        yield (
            f"commanded_velocity with a gain of {gain:g} 1/s and a delay of {delay:.2f} s "
            f"(product {gain * delay:.2f}, above 1) can oscillate; choose another cloud.predictor, "
            f"or gains below {1.0 / delay:.2g}"
        )
