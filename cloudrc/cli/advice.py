"""Warn before a flight of settings that do not fit together, and name the key and value that would.

The warnings are estimates: the flight takes place in any case.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from math import ceil
from typing import TYPE_CHECKING

from cloudrc.cli.output import print_line

if TYPE_CHECKING:
    from cloudrc.config.load import ResolvedExperiment
    from cloudrc.config.schema import Direction

PERIODS = 0.02
"""Time that a command waits in cloud and in world, together at most two periods [s]."""
SPREADS = {"uniform": 1.0}
"""Distribution of the jitter -> largest deviation in jitters; 2 for those with tails."""


def warn(experiment: ResolvedExperiment) -> None:
    """Print a line on stderr for each problem of the experiment."""
    for text in advise(experiment):
        print_line(f"cloudrc: warning: {text}", sys.stderr)


def advise(experiment: ResolvedExperiment) -> Iterator[str]:
    """Describe the settings of an experiment that do not fit together."""
    ways = [_delays(way) for way in (experiment.uplink, experiment.downlink)]
    mean, longest = (sum(values) for values in zip(*ways, strict=True))
    yield from _long_link(experiment, mean, longest)
    yield from _control(experiment, mean)


def _delays(way: Direction) -> tuple[float, float]:
    """Return the mean delay of one direction at its worst time, and its longest usual delay [s]."""
    if way.trace is not None:
        from pathlib import Path

        from cloudrc.link.traces import read_trace

        delays = sorted(read_trace(Path(way.trace)).delays)
        return sum(delays) / len(delays), delays[int(0.95 * (len(delays) - 1))]
    delay, jitter, found = way.delay_ms, way.jitter_ms, [(way.delay_ms, way.jitter_ms)]
    for change in way.changes:
        delay = delay if change.delay_ms is None else change.delay_ms
        jitter = jitter if change.jitter_ms is None else change.jitter_ms
        found.append((delay, jitter))
    spread = SPREADS.get(way.distribution, 2.0)
    mean = max(delay for delay, _ in found)
    return mean * 1e-3, max(delay + spread * jitter for delay, jitter in found) * 1e-3


def _long_link(experiment: ResolvedExperiment, mean: float, longest: float) -> Iterator[str]:
    """Compare the mean and longest round trip [s] with the limits of guard and cloud."""
    age_max, cloud = experiment.guard.command_age_max_ms * 1e-3, experiment.cloud
    trip = f"the round trip takes {mean * 1e3:.0f} ms, up to {longest * 1e3:.0f} ms"
    if longest + PERIODS > age_max:
        limit = ceil((longest + PERIODS) * 1e2) * 10
        state = "never flies" if mean > age_max else "often holds"
        yield (
            f"{trip}, but the guard refuses commands older than {age_max * 1e3:.0f} ms, so the "
            f"robot {state}; a value that fits: --set guard.command_age_max_ms={limit}"
        )
    if mean > cloud.horizon_max_s:
        fits = f"--set cloud.horizon_max_s={ceil(longest * 10) / 10:g}"
        yield f"{trip}, more than cloud predicts; a value that fits: {fits}"
    elif longest - mean > cloud.freeze_after_s:
        fits = f"--set cloud.freeze_after_s={ceil((longest - mean + PERIODS) * 10) / 10:g}"
        yield f"{trip}, so cloud freezes at times; a value that fits: {fits}"


def _control(experiment: ResolvedExperiment, mean: float) -> Iterator[str]:
    """Look at the gains with a mean round trip of `mean` [s]."""
    controller = experiment.cloud.controller
    if controller.name != "pid":
        return
    values, cap = controller.model_extra or {}, experiment.guard.speed_max_mps
    speed_max = values["speed_max"]
    winds_up = values["integral_limit"] is None and (speed_max is None or speed_max > cap)
    if any(values["gain_i"]) and winds_up:
        yield (
            f"cloud.controller integrates while the guard caps the speed at {cap:.3g} m/s; "
            f"a value that fits: --set cloud.controller.speed_max={cap:.3g}"
        )
    gain = max(values["gain_p"])
    if experiment.cloud.predictor.name == "commanded_velocity" and gain * mean > 1.0:
        yield (
            f"commanded_velocity with a gain of {gain:g} 1/s and a round trip of {mean:.2f} s "
            f"(product {gain * mean:.2f}, above 1) can oscillate; choose another cloud.predictor, "
            f"or gains below {1.0 / mean:.2g}"
        )
