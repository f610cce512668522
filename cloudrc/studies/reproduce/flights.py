# SPDX-License-Identifier: Apache-2.0

"""Plan and fly what the paper flew: its mission over its links, with the seeds 1 to n."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

from cloudrc.base.outside.reuse import reuse_results
from cloudrc.config.load import load_experiment
from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.flight.experiment import load
from cloudrc.flight.in_memory import fly_in_memory, or_error, row_of
from cloudrc.flight.trials.fingerprint import experiment_facts, fingerprint
from cloudrc.flight.trials.plan import PlannedFlight
from cloudrc.flight.trials.rows import Row
from cloudrc.studies.reproduce.measures import measure

ORDERS = {"arrival": "paper-verbatim", "newest": "paper"}
"""Which command the robot follows, the last to arrive or the newest -> its experiment."""
LINKS = {"P1": (20.0, 10.0), "P2": (45.0, 25.0), "P3": (70.0, 40.0)}
"""Link of the paper -> its delay and its jitter [ms]."""
CHANGES = (10.0, 20.0)
"""When P2 and P3 begin in a mission that meets all three [s]; it takes about 30 s."""
ALL, HALVED, WORST = "P1-P2-P3", "halved", "P3"
"""Columns of the missions with all three links, with half of each delay and jitter in the second;
and of the worst link."""
LIMIT, PUBLISHED, RAISED = "world.onboard.integral_limit_xy", "0.10", "0.30"
"""Key of the limit of the onboard integral term; that of the published controller, and one that
carries the weight of the arm [m]."""


class PaperFlights(NamedTuple):
    """What the flights of one cell of the table have in common."""

    order: str  # of `ORDERS`
    column: str  # of the table
    settings: Sequence[str]  # KEY=VALUE
    changes: Sequence[float] = ()  # when the link changes [s]
    hover: str = ""  # limit of the onboard integral term in a hover [m]; "": the mission

    @property
    def point(self) -> dict[str, str]:
        """The condition as the point of its rows."""
        return {"order": self.order, "column": self.column, "hover": self.hover}


def conditions(link: str = "") -> Iterator[PaperFlights]:
    """Yield all conditions; `link` is a profile or a trace of the reader, "" if there is none."""
    for order in ORDERS:
        for name in LINKS:
            yield PaperFlights(order, name, [f"link.profile=paper-{name.lower()}"])
        yield PaperFlights(order, ALL, _settings(1.0), CHANGES)
        yield PaperFlights(order, HALVED, _settings(0.5), CHANGES)
        if link:
            yield PaperFlights(order, Path(link).name, _settings_of(link))
    for limit in (PUBLISHED, RAISED):
        settings = f"link.profile=paper-{WORST.lower()}", f"{LIMIT}={limit}"
        yield PaperFlights("newest", WORST, settings, hover=limit)


def _settings(factor: float) -> list[str]:
    """Return the settings for all three links in turn, their delays multiplied by `factor` [1]."""
    first, *later = (
        f"delay_ms: {factor * delay:g}, jitter_ms: {factor * jitter:g}"
        for delay, jitter in LINKS.values()
    )
    begin = zip(CHANGES, later, strict=True)
    changes = ", ".join(f"{{at_s: {at:g}, {values}}}" for at, values in begin)
    direction = f"{{{first}, changes: [{changes}]}}"
    return ["link.profile=ideal", *(f"link.{way}={direction}" for way in ("uplink", "downlink"))]


def _settings_of(link: str) -> list[str]:
    """Return the settings for a link of the reader; a trace begins elsewhere with each seed."""
    ways = traces_of(link)
    if not ways:
        return [f"link.profile={link}"]
    traces = (f"link.{way}.trace={each}" for way, each in ways.items())
    return ["link.profile=ideal", *traces, "link.start_s=random"]


def traces_of(link: str) -> dict[str, Path]:
    """Return the trace of each way of a link of the reader, which may be one; {} for a profile.

    `cloudrc link record -o mine.csv` may have written mine-uplink.csv and mine-downlink.csv, which
    the name mine.csv means, too.
    """
    path = Path(os.path.expanduser(link))
    if path.suffix != ".csv":
        return {}
    ways = {way: path.with_stem(f"{path.stem}-{way}") for way in ("uplink", "downlink")}
    if path.exists() or not all(each.exists() for each in ways.values()):
        ways = dict.fromkeys(ways, path)
    return ways


def plan(seeds: int, link: str = "") -> list[PlannedFlight]:
    """Check all flights, with the seeds 1 to `seeds`, and return them."""
    flights = list[PlannedFlight]()
    with reuse_results():
        for each in conditions(link):
            resolved = load("hover" if each.hover else ORDERS[each.order], each.settings)
            known = fingerprint(experiment_facts(resolved), "reproduce", each.point)
            flown = partial(fly, changes=each.changes)
            first = PlannedFlight(known, each.point, 1, resolved, flown)
            flights += [first._replace(seed=seed) for seed in range(1, seeds + 1)]
    return flights


def fly(experiment: ResolvedExperiment, changes: Sequence[float]) -> Row:
    """Fly; the row also has what `measure` measures over a link that changes at `changes` [s]."""

    def flown() -> Row:
        found = fly_in_memory(experiment)
        return {**row_of(found, experiment), "measured": measure(found.flight, changes)}

    return or_error(flown)


def shown() -> ResolvedExperiment:
    """Return the experiment that the figure shows: seed 1 over all three links, as published."""
    return load_experiment(ORDERS["arrival"], [*_settings(1.0), "seed=1"])
