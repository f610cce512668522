"""Warn before a flight of settings that do not fit together, and name the key and value that would.

The delays come from a simulation of the link alone, with the random numbers of the flight. The
flight takes place in any case.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from heapq import heappop, heappush
from math import ceil
from typing import TYPE_CHECKING, Any

from cloudrc.cli.output import print_line

if TYPE_CHECKING:
    from cloudrc.config.load import ResolvedExperiment

PERIOD_NS = 10_000_000
"""Time between two telemetry datagrams, and between two commands [ns]."""
PERIODS = 2000
"""Number of simulated periods: 20 s."""


def warn(experiment: ResolvedExperiment) -> None:
    """Print a line on stderr for each problem of the experiment."""
    for text in advise(experiment):
        print_line(f"cloudrc: warning: {text}", sys.stderr)


def advise(experiment: ResolvedExperiment) -> Iterator[str]:
    """Describe the settings of an experiment that do not fit together."""
    ages, echoes = _simulate(experiment)
    if ages:
        yield from _long_link(experiment, ages, echoes)
        yield from _control(experiment, sum(ages) / len(ages))


def _simulate(experiment: ResolvedExperiment) -> tuple[list[float], list[float]]:
    """Exchange telemetry and commands over the link, without its blackouts.

    Returns:
        Ages at the end of each period: of the odometry behind the command in force [s], and of
        the newest command that telemetry has echoed to cloud [s].
    """
    from cloudrc.assembly import link_profile
    from cloudrc.link.model import LinkDirection
    from cloudrc.tunnel.codec import PLAN_SIZES, SIZES, Kind

    plan = round(experiment.cloud.plan_s * 1e9) // PERIOD_NS
    newest_wins = experiment.tunnel.order == "newest" or plan > 0
    sizes = {**SIZES, Kind.COMMAND: SIZES[Kind.COMMAND] + PLAN_SIZES[plan]}
    links = [
        LinkDirection(
            link_profile(way.model_copy(update={"blackouts": ()})), experiment.seed, uplink=uplink
        )
        for way, uplink in ((experiment.uplink, True), (experiment.downlink, False))
    ]
    # Per direction: the newest arrival, as its stamp and the stamp that it contains [ns].
    arrived: list[tuple[int, int] | None] = [None, None]
    pending: list[tuple[int, int, tuple[int, int]]] = []
    ages, echoes = list[float](), list[float]()
    for period in range(PERIODS):
        now_ns = period * PERIOD_NS
        while pending and pending[0][0] <= now_ns:
            _, way, datagram = heappop(pending)
            newest = arrived[way]
            if newest is None or datagram[0] > newest[0] or not newest_wins:
                arrived[way] = datagram
        telemetry, command = arrived
        if command is not None:
            ages.append((now_ns + PERIOD_NS - command[1]) * 1e-9)
        if telemetry is not None and telemetry[1] >= 0:
            echoes.append((now_ns + PERIOD_NS - telemetry[1]) * 1e-9)
        sent = [(0, Kind.TELEMETRY, command), (1, Kind.COMMAND, telemetry)]
        for way, kind, last in sent if telemetry is not None else sent[:1]:
            datagram = now_ns, -1 if last is None else last[0]
            for at_ns in links[way].send(1, kind, period, sizes[kind], now_ns):
                heappush(pending, (at_ns, way, datagram))
    return ages, echoes


def _long_link(
    experiment: ResolvedExperiment, ages: list[float], echoes: list[float]
) -> Iterator[str]:
    """Compare ages of odometry and of echoes [s] with the limits of guard and cloud."""
    age_max, cloud = experiment.guard.command_age_max_ms * 1e-3, experiment.cloud
    mean, longest = sum(ages) / len(ages), max(ages)
    lasts = max(age_max, min(ages) + min(cloud.plan_s, experiment.guard.plan_max_s))
    delay = f"commands follow their odometry after {mean * 1e3:.0f} ms on average"
    if min(ages) > age_max or longest > lasts:
        how = "never flies" if min(ages) > age_max else "holds again and again"
        yield (
            f"{delay}, after {longest * 1e3:.0f} ms at most, and the guard refuses commands after "
            f"{age_max * 1e3:.0f} ms, so the robot {how}; a value that fits: "
            f"--set guard.command_age_max_ms={_round_up(longest, 0.01) * 1e3:.0f}"
        )
    silence = max(echoes, default=0.0) - min(mean, cloud.horizon_max_s)
    if mean > cloud.horizon_max_s:
        fits = f"--set cloud.horizon_max_s={_round_up(longest, 0.1):g}"
        yield f"{delay}, which is more than cloud predicts; a value that fits: {fits}"
    elif silence > cloud.freeze_after_s:
        fits = f"--set cloud.freeze_after_s={_round_up(silence, 0.1):g}"
        yield f"{delay}, and cloud freezes at times; a value that fits: {fits}"


def _round_up(value: float, step: float) -> float:
    """Return a multiple of `step` that is at least one step above a value, in any unit."""
    return round((ceil(value / step) + 1) * step, 3)


def _control(experiment: ResolvedExperiment, delay: float) -> Iterator[str]:
    """Check the gains of the PID with a mean delay [s] from odometry to command."""
    controller = experiment.cloud.controller
    if controller.name != "pid":
        return
    values: dict[str, Any] = controller.model_extra or {}
    cap, speed_max = experiment.guard.speed_max_mps, values["speed_max"]
    winds_up = values["integral_limit"] is None and (speed_max is None or speed_max > cap)
    if any(values["gain_i"]) and winds_up:
        yield (
            f"cloud.controller integrates while the guard caps the speed at {cap:.3g} m/s; "
            f"a value that fits: --set cloud.controller.speed_max={cap:.3g}"
        )
    gain = max(values["gain_p"])
    if experiment.cloud.predictor.name == "commanded_velocity" and gain * delay > 1.0:
        yield (
            f"commanded_velocity with a gain of {gain:g} 1/s and a delay of {delay:.2f} s "
            f"(product {gain * delay:.2f}, above 1) can oscillate; choose another cloud.predictor, "
            f"or gains below {1.0 / delay:.2g}"
        )
