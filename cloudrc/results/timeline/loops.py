# SPDX-License-Identifier: Apache-2.0

"""What a timeline shows of a control loop: its commands in stages, marks, and what lasts longer."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from cloudrc.results.metrics.budget import UNKNOWN_NS, Budget, Stage, budget_of, summary
from cloudrc.results.metrics.flight import Array, Flight, rows_of
from cloudrc.results.record.columns import datagrams
from cloudrc.wire.records import UNDER_WAY

GUARD, MISSION = "guard", "mission"
"""Names of tracks beside those of the stages."""
SHARES = {"least": 0.0, "p10": 10.0, "p50": 50.0, "p90": 90.0, "p99": 99.0, "most": 100.0}
"""Name of a percentile of the time in the cell -> the percentile [%]."""
NOTHING = "the recording tells of no command that the robot followed"


class Mark(NamedTuple):
    """An instant."""

    track: str  # name of a stage, or of another track
    at_ns: int
    text: str


class Phase(NamedTuple):
    """What lasts some time; `track` is that of a `Mark`."""

    track: str
    begin_ns: int
    end_ns: int
    text: str


class Loop(NamedTuple):
    """A control loop; all times are on one clock [ns], which shows `begin_ns` as it begins."""

    budget: Budget
    document: dict[str, Any]  # the budget in plain values, or what else is known
    begin_ns: int
    until_ns: Array  # until when the robot acts on each command of the budget [ns], shape (n,)
    marks: tuple[Mark, ...] = ()
    phases: tuple[Phase, ...] = ()


def of_flight(flight: Flight) -> Loop:
    """Return what a timeline shows of a flight."""
    budget = budget_of(flight)
    applied_ns = flight.during("/command_applied")["stamp_ns"]
    changes_ns, end_ns = flight.recording["/guard"]["stamp_ns"], flight.end_ns or 0
    edges_ns = np.unique(np.concatenate([applied_ns, changes_ns, [end_ns]]))
    next_row = edges_ns.searchsorted(budget.ns[-1], "right").clip(max=len(edges_ns) - 1)
    marks = *_losses(flight, budget), *_changes(flight)
    found = budget.document or _round_trips(flight)
    begin_ns = flight.mission_ns or 0
    return Loop(budget, found, begin_ns, edges_ns[next_row], marks, (*_missions(flight),))


def _round_trips(flight: Flight) -> dict[str, Any]:
    """Return what cloud alone knows, if the robot followed no command: round trips [s]."""
    estimates, trips = flight.recording["/delay_estimate"], {}
    for name in ("rtt", "loop_delay"):
        known = estimates[name][np.isfinite(estimates[name])]
        if len(known):
            trips[name] = summary(known * 1e9)
    return {"round_trips": trips, "notes": [NOTHING]}


def _losses(flight: Flight, budget: Budget) -> Iterator[Mark]:
    """Yield telemetry that never arrived, though later telemetry did."""
    sent, arrived = flight.recording["/telemetry"], datagrams(flight.recording["/uplink_delay"])
    if len(arrived) and budget.stages:
        track = next(each.text for each in budget.stages if "uplink" in each.name)
        numbers = datagrams(sent)
        rows = np.flatnonzero(~np.isin(numbers, arrived) & (numbers < arrived.max()))
        for at_ns, counter in zip(sent["stamp_ns"][rows], sent["counter"][rows], strict=True):
            yield Mark(track, int(at_ns), f"telemetry #{counter} lost")


def _changes(flight: Flight) -> Iterator[Mark]:
    for at_ns, cause in rows_of(flight.recording["/guard"], "stamp_ns", "cause"):
        yield Mark(GUARD, at_ns, f"guard: {cause}")
    for at_ns, text in rows_of(flight.recording["/mission"], "stamp_ns", "text"):
        yield Mark(MISSION, at_ns, text)


def _missions(flight: Flight) -> Iterator[Phase]:
    began_ns = None
    for at_ns, event in rows_of(flight.recording["/mission"], "stamp_ns", "event"):
        if event == "started":
            began_ns = at_ns
        elif event not in UNDER_WAY and began_ns is not None:
            yield Phase(MISSION, began_ns, at_ns, f"mission: {event}")
            began_ns = None


def of_fleet(loops: Mapping[str, Loop]) -> dict[str, Any]:
    """Return the budgets of the loops of a fleet, by the names of its robots, in plain values.

    `cell` has, for each direction in words, how long packets of all robots were in the cell:
    percentiles [s].
    """
    waits = dict[str, list[Array]]()
    for loop in loops.values():
        lengths = zip(loop.budget.stages, np.diff(loop.budget.followed, axis=0), strict=True)
        for stage, length_ns in lengths:
            if stage.name.endswith("_cell"):
                waits.setdefault(stage.text, []).append(length_ns)
    cell = {
        text: {
            name: float(np.percentile(np.concatenate(found), share)) * 1e-9
            for name, share in SHARES.items()
        }
        for text, found in waits.items()
    }
    return {"budgets": {name: loop.document for name, loop in loops.items()}, "cell": cell}


def of_document(found: Mapping[str, Any]) -> Loop:
    """Return what a timeline shows of an episode, whose file `cloudrc eval` has written.

    Ticks begin at 0 ns. Raise a KeyError or ValueError for another file.
    """
    stages = tuple(Stage(name, text) for name, text in found["stages"].items())
    cuts_ns = np.array(found["cuts_ns"], np.int64).reshape(len(stages) + 1, -1)
    numbers, ended = np.array(found["ticks"], np.int64), np.array(found["ended"], "U10")
    budget = Budget(stages, np.where(cuts_ns < 0, UNKNOWN_NS, cuts_ns), numbers, ended)
    acts_ns = budget.ns[-1]
    edges_ns = np.unique(np.append(budget.followed[-1], acts_ns.max(initial=0)))
    until_ns = edges_ns[edges_ns.searchsorted(acts_ns, "right").clip(max=len(edges_ns) - 1)]
    return Loop(budget, budget.document or {"round_trips": {}, "notes": [NOTHING]}, 0, until_ns)
