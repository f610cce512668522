"""`make bench-link`: compare the relay with its model.

Probes go through the processes that `cloudrc link verify` starts. The relay itself measures how
late it sends. Close other programs first, because they delay the relay. Exit codes: 0 all limits
were kept, 1 a limit was exceeded.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
from statistics import median
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.config.shipped import names
from cloudrc.errors import CloudrcError
from cloudrc.link.profile import Timeline
from cloudrc.link.state import RELEASED_SUFFIX, STATE_FILE
from cloudrc.link.traces import link_profile
from cloudrc.link.verify.judge import Flow, Measurement
from cloudrc.link.verify.probe import FIRST_PROBE, PROBE
from cloudrc.runs.links.under_test import WAYS, measure, run_link
from cloudrc.runs.links.verify import find_experiment
from cloudrc.text import table
from cloudrc.tunnel.codec import SIZES

Array: TypeAlias = NDArray[np.float64]
AFTER = 2.0
"""Time for which the probes continue after the last change of a profile [s]."""
TIE = 5e-6
"""If two datagrams are due within this time [s], their order is not checked."""


class Judged(NamedTuple):
    """Comparison of the probes of one direction with the model."""

    errors: Array  # measured minus modelled delays of all that arrived [s]
    wrong: int  # number of probes that were lost, or arrived, or were copied, not as drawn
    swapped: int  # number of probes out of the order drawn
    released: dict[str, int]  # the relay's own counts, as in `ReleaseErrors.in_ns`


class Line(NamedTuple):
    """One line of the result table."""

    what: str
    asked: str
    measured: str
    held: bool


def main() -> int:
    """Measure, print the results and return the exit code."""
    parser = argparse.ArgumentParser(prog="make bench-link", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a tenth of the time; for a look")
    parser.add_argument("-o", "--output", choices=("table", "json"), default="table")
    options = parser.parse_args()
    rounds, duration, span = (2, 3.0, 2.0) if options.quick else (5, 20.0, 12.0)
    try:
        lines = releases(rounds, duration) + profiles(span)
    except CloudrcError as error:
        print(f"bench-link: {error}", file=sys.stderr)
        return error.exit_code
    if options.output == "json":
        print(json.dumps({"lines": [line._asdict() for line in lines]}))
    else:
        system = f"Linux {platform.release()}, {os.cpu_count()} CPUs, load {os.getloadavg()[0]:.1f}"
        rows = [(*line[:3], "" if line.held else "MISSED") for line in lines]
        print(table([(system, "asked", "measured", ""), *rows]))
    return 0 if all(line.held for line in lines) else 1


def releases(rounds: int, duration: float) -> list[Line]:
    """Measure how late the relay sends at 1 kHz, each time for `duration` [s]."""
    experiment = find_experiment("ideal", [f"link.{way}.delay_ms=20" for way in WAYS])
    found = [compare(experiment, duration, 1000.0)["uplink"].released for _ in range(rounds)]
    p50, p99 = (
        1e-3 * median(one[f"release_error_{q}_ns"] for one in found) for q in ("p50", "p99")
    )
    early, count = (sum(one[name] for one in found) for name in ("released_early", "released"))
    return [
        Line("release error p50, 1 kHz", "<= 60 us", f"{p50:.1f} us", p50 <= 60),
        Line("release error p99, 1 kHz", "<= 400 us", f"{p99:.0f} us", p99 <= 400),
        Line("released early", "0", f"{early} of {count}", early == 0),
    ]


def profiles(duration: float) -> list[Line]:
    """Measure all shipped profiles at 100 Hz, each for `duration` [s] or its time line."""
    judged = {}
    for name in names("profile"):
        experiment = find_experiment(name, [])
        last = Timeline(link_profile(experiment.uplink)).last_ns * 1e-9
        for way, one in compare(experiment, max(duration, last and last + AFTER), 100.0).items():
            judged[f"{name} {way}"] = one
    every = np.concatenate([one.errors for one in judged.values()])
    wrong, swapped = (sum(one[n] for one in judged.values()) for n in (1, 2))
    early = int((every < 0).sum())
    (mean, biased), (spread, noisy) = (
        max((1e3 * float(abs(function(one.errors))), name) for name, one in judged.items())
        for function in (np.mean, np.std)
    )
    return [
        Line("measured minus drawn delay, mean, worst profile", "<= 0.3 ms",
             f"{mean:.3f} ms ({biased})", mean <= 0.3),
        Line("the same, deviation, worst profile", "<= 0.5 ms",
             f"{spread:.3f} ms ({noisy})", spread <= 0.5),
        Line("lost or arrived, not as drawn", "0", f"{wrong} of {every.size}", not wrong),
        Line("out of the order drawn (by > 5 us)", "0", f"{swapped}", swapped == 0),
        Line("released early, profiles", "0", f"{early} of {every.size}", early == 0),
    ]  # fmt: skip


def compare(experiment: ResolvedExperiment, duration: float, rate: float) -> dict[str, Judged]:
    """Send probes in both directions at `rate` [1/s] for `duration` [s]; compare with the model."""
    # Half a period away from the instants at which time lines change: a probe takes time.
    sent = FIRST_PROBE + (np.arange(round(duration * rate)) + 0.5) / rate
    plans = {
        way: Measurement(
            link_profile(getattr(experiment, way)),
            Flow(experiment.seed, way == "uplink", PROBE, SIZES[kind]),
            sent,
        )
        for way, (_, _, kind) in WAYS.items()
    }
    judged = {}
    with run_link(experiment, "relay") as ways:
        for way, measured in measure(ways, plans).items():
            drawn = plans[way].draw(measured.sent)
            both = np.isfinite(measured.delays) & np.isfinite(drawn.delays)
            arrived, due = ((one.sent + one.delays)[both] for one in (measured, drawn))
            swapped = int(np.sum(np.diff(due[np.argsort(arrived)]) < -TIE))
            wrong = int(np.sum(measured.copies != drawn.copies))
            released = (ways[way].folder / STATE_FILE).with_suffix(RELEASED_SUFFIX).read_text()
            judged[way] = Judged(arrived - due, wrong, swapped, json.loads(released))
    return judged


if __name__ == "__main__":
    sys.exit(main())
