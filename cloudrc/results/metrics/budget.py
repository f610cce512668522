# SPDX-License-Identifier: Apache-2.0

"""Where the age of a command comes from: its stages, from the measurement to the robot's action.

A stage is what happens between two stamps, and `STAGES` has them in their order. Each begins when
the one before ends, so the stages of a command add up to its age when it begins to act, in whole
nanoseconds. A stage whose end no message tells becomes a part of the next one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property, lru_cache, partial
from typing import Any, NamedTuple

import numpy as np

from cloudrc.results.metrics.age import describe
from cloudrc.results.metrics.control import ages_at_actuator
from cloudrc.results.metrics.descriptions import AGE_STAGES, SCAN_STAGES
from cloudrc.results.metrics.flight import Array, Columns, Flight, add_measures, select
from cloudrc.results.metrics.perception import acted
from cloudrc.results.record.columns import Column, datagrams, join
from cloudrc.wire.messages import GuardState
from cloudrc.wire.records import UNSENT

UNKNOWN_NS = np.iinfo(np.int64).min
"""Stands for an instant that no message tells [ns]."""
ASTRAY_MAX = 0.01
"""Largest share of the commands with stamps of cloud's clock astray, if the clocks are in common
[1]: while world lags behind its machine, its clock is interpolated."""
ASTRAY_NS = 2_000_000
"""A stamp is astray if it is out of order by more than this [ns]: a step of world. Over a link
without delay, a busy machine puts many stamps out of order by less."""
NO_CLOCK = (
    "the clocks of world and cloud are not in common: the delays of both directions are told "
    "together"
)
ONE_END = "the recording has one end of the loop: what happened at the other end is told together"


LINK_PARTS = "queue_ns", "request_ns", "grant_ns", "repeat_ns"
"""Where a datagram waits in the link, in its order: columns of /link_wait."""


class Commands:
    """Commands of a flight, and the instants of each that its recording tells.

    Attributes:
        numbers: Their datagrams, shape (n,), as all others.
        basis_ns: Stamps of the odometry behind them, world's clock [ns].
    """

    def __init__(self, flight: Flight, numbers: Column, basis_ns: Array) -> None:
        """Take commands by their datagrams; `basis_ns` are the stamps of their odometry [ns]."""
        self._flight, self.numbers, self.basis_ns = flight, numbers, basis_ns

    @cached_property
    def telemetry(self) -> Array:
        """The datagrams that brought their odometry to cloud."""
        sent = self._flight.recording["/telemetry"]
        return _look_up(self.basis_ns, sent["odometry_stamp_ns"], datagrams(sent))

    def at(self, topic: str, keys: Array) -> Array:
        """Return the stamps of the rows of a topic about the datagrams `keys` [ns].

        Of a topic of arrivals, the rows of datagrams that were used count.
        """
        rows: Any = self._flight.recording[topic]
        if "used" in rows.columns:
            rows = select(rows.columns, rows["used"])
        return _look_up(keys, datagrams(rows), rows["stamp_ns"])

    def behind_cell(self, keys: Array, sent_ns: Array, *, uplink: bool) -> Array:
        """Return when the datagrams `keys`, sent at `sent_ns` [ns], had left the cell [ns]."""
        rows = self._flight.recording["/cell_wait"].columns
        rows = select(rows, rows["uplink"] == uplink)
        waits_ns = _look_up(keys, datagrams(rows), rows["wait_ns"])
        is_known = (waits_ns != UNKNOWN_NS) & (sent_ns != UNKNOWN_NS)
        return np.where(is_known, sent_ns + np.where(is_known, waits_ns, 0), UNKNOWN_NS)

    def behind_link(self, part: str, *, uplink: bool) -> Array:
        """Return when the datagrams had a part of the link behind them [ns].

        `part` is the last one that counts: a column of /link_wait. A part that no datagram has is
        unknown, and so are all parts of a datagram whose copy arrived before it.
        """
        keys, arrivals = self.telemetry, "/uplink_delay"
        sent_ns = self.at("/telemetry", keys)
        if not uplink:
            keys, arrivals, sent_ns = self.numbers, "/downlink_delay", self.left_ns
        cell_ns = self.behind_cell(keys, sent_ns, uplink=uplink)
        begin_ns = np.where(cell_ns == UNKNOWN_NS, sent_ns, cell_ns)
        rows = self._flight.recording["/link_wait"].columns
        rows = select(rows, rows["uplink"] == uplink)
        if not rows[part].any():
            return _untold(self)
        parts_ns = np.cumsum([rows[name] for name in LINK_PARTS], axis=0)
        through_ns, all_ns = (
            _look_up(keys, datagrams(rows), parts_ns[row]) for row in (LINK_PARTS.index(part), -1)
        )
        is_known = (through_ns != UNKNOWN_NS) & (begin_ns != UNKNOWN_NS)
        is_known &= begin_ns + np.where(is_known, all_ns, 0) <= self.at(arrivals, keys)
        return np.where(is_known, begin_ns + np.where(is_known, through_ns, 0), UNKNOWN_NS)

    @property
    def left_ns(self) -> Array:
        """When the commands left cloud [ns]: at once, unless a computation took time."""
        left_ns = self.at("/left", self.numbers)
        return np.where(left_ns == UNKNOWN_NS, self.at("/delay_estimate", self.numbers), left_ns)


def _look_up(keys: Array, known: Array, values: Array) -> Array:
    """Return the value of each key [any unit], `UNKNOWN_NS` for one that is not `known`."""
    found = np.full(len(keys), UNKNOWN_NS)
    rows, source = join(keys, known)
    found[rows] = values[source]
    return found


def _untold(commands: Commands) -> Array:
    return np.full(len(commands.numbers), UNKNOWN_NS)


class Stage(NamedTuple):
    """A stage of a command: it ends at `end` [ns], and begins where the one before ends."""

    name: str  # in report.json, and behind `budget_` in tables
    text: str  # for people
    end: Callable[[Commands], Array] = _untold
    at_cloud: bool = False  # whether a stamp of cloud's clock tells the end
    is_extra: bool = False  # whether most flights do not have it


def _stage(
    name: str,
    end: Callable[[Commands], Array],
    *,
    at_cloud: bool = False,
    is_extra: bool = False,
) -> Stage:
    return Stage(name, (AGE_STAGES | SCAN_STAGES)[name], end, at_cloud, is_extra)


STAGES = (
    _stage("observation", lambda c: c.at("/telemetry", c.telemetry)),
    _stage("uplink_cell", lambda c: c.behind_cell(
        c.telemetry, c.at("/telemetry", c.telemetry), uplink=True), is_extra=True),
    _stage("uplink_rate", lambda c: c.behind_link("queue_ns", uplink=True), is_extra=True),
    _stage("uplink_request", lambda c: c.behind_link("request_ns", uplink=True), is_extra=True),
    _stage("uplink_grant", lambda c: c.behind_link("grant_ns", uplink=True), is_extra=True),
    _stage("uplink_repeat", lambda c: c.behind_link("repeat_ns", uplink=True), is_extra=True),
    _stage("uplink", lambda c: c.at("/uplink_delay", c.telemetry), at_cloud=True),
    _stage("queue", lambda c: c.at("/delay_estimate", c.numbers), at_cloud=True),
    _stage("compute", lambda c: c.at("/left", c.numbers), at_cloud=True, is_extra=True),
    _stage("downlink_cell", lambda c: c.behind_cell(
        c.numbers, c.left_ns, uplink=False), at_cloud=True, is_extra=True),
    _stage("downlink_rate", lambda c: c.behind_link("queue_ns", uplink=False),
           at_cloud=True, is_extra=True),
    _stage("downlink_grant", lambda c: c.behind_link("grant_ns", uplink=False),
           at_cloud=True, is_extra=True),
    _stage("downlink_repeat", lambda c: c.behind_link("repeat_ns", uplink=False),
           at_cloud=True, is_extra=True),
    _stage("downlink", lambda c: c.at("/downlink_delay", c.numbers)),
    _stage("wait", lambda c: c.at("/command_applied", c.numbers)),
)  # fmt: skip
"""All stages of a command, in their order. A further one is a row here, with its words in
`AGE_STAGES`."""
NUMBER = "budget_"
"""Begin of the names of the metrics; the name of a stage follows."""
NEEDED = (
    *("/telemetry", "/uplink_delay", "/delay_estimate", "/downlink_delay", "/command_applied"),
    *("/guard", "/mission", "/left", "/cell_wait", "/link_wait", "/perception"),
)
"""Topics that the budget of a flight needs."""
ENDS = {
    "withheld": "withheld by cloud",
    "lost": "lost",
    "superseded": "superseded by a newer one",
    "guard": "dropped by the guard",
}
"""Where a command ended that the robot never followed -> in words."""


class Budget(NamedTuple):
    """Commands cut into stages.

    `ns` has the begin of the first stage and the ends of all [ns], shape (m + 1, n), of m stages
    and n commands; `UNKNOWN_NS` where a command had ended before.
    """

    stages: tuple[Stage, ...]
    ns: Array
    numbers: Column = np.zeros(0, np.int64)  # datagrams of the commands
    ended: Array = np.zeros(0, "U1")  # key of `ENDS`, "" for a command that the robot followed
    average: float | None = None  # age of what the robot acts on, averaged over time [s]
    notes: tuple[str, ...] = ()  # what is told together or left out, and why
    scans: Budget | None = None  # of the scans on which the robot acted, up to then

    @property
    def followed(self) -> Array:
        """The columns of `ns` of the commands that the robot followed, shape (m + 1, k) [ns]."""
        whole: Array = (self.ns != UNKNOWN_NS).all(axis=0)
        found: Array = self.ns[:, whole & (self.ended == "")]
        return found

    @property
    def document(self) -> dict[str, Any] | None:
        """The budget in plain values, times in s; None if the robot followed no command."""
        ns = self.followed
        if not ns.size:
            return None
        lengths = zip(self.stages, np.diff(ns, axis=0), strict=True)
        counts = {end: int((self.ended == end).sum()) for end in ENDS}
        return {
            "stages": {
                stage.name: {"text": stage.text, **summary(length_ns)}
                for stage, length_ns in lengths
            },
            "age": summary(ns[-1] - ns[0]),
            "time_average": self.average,
            "commands": ns.shape[1],
            "ended": {end: count for end, count in counts.items() if count},
            "notes": [*self.notes],
            **({"scans": self.scans.document} if self.scans else {}),
        }


def summary(lengths_ns: Array) -> dict[str, float]:
    """Return mean and 99th percentile [s] of the times `lengths_ns` [ns], at least one."""
    lengths = lengths_ns * 1e-9
    return {"mean": float(lengths.mean()), "p99": float(np.percentile(lengths, 99.0))}


@lru_cache(maxsize=1)  # metrics, figure and report ask for the same flight
def budget_of(flight: Flight) -> Budget:
    """Cut the commands of a flight into their stages, also those that the robot never followed."""
    applied = flight.during("/command_applied")
    made, ended = endings(flight)
    known = np.concatenate([datagrams(applied), datagrams(made)])
    bases_ns = np.concatenate([applied["basis_stamp_ns"], made["basis_stamp_ns"]])
    metadata = flight.recording.metadata
    method = metadata.get("clock_offset_method", "same clock")
    found = _cut(STAGES, Commands(flight, known, bases_ns), len(applied["epoch"]), method)
    found = found._replace(
        scans=_scans_of(flight, method),
        numbers=known,
        ended=np.concatenate([np.full(len(applied["epoch"]), ""), ended]),
        average=describe(ages_at_actuator(flight)).get("mean"),
    )
    notes = [*found.notes]
    if more := len(applied["epoch"]) - found.followed.shape[1]:
        notes.append(f"{more} commands are left out: of them, the recording lacks messages")
    uncertain_ns = int(metadata.get("clock_offset_uncertainty_ns", 0))
    if uncertain_ns and NO_CLOCK not in notes:
        notes.append(
            "the stamps of the loop compare two clocks: uplink and downlink may be wrong by up to "
            f"{uncertain_ns * 1e-6:.1f} ms, their sum is right"
        )
    return found._replace(notes=tuple(notes))


def endings(flight: Flight) -> tuple[Columns, Array]:
    """Find the commands that cloud made in a flight, and that the robot never followed.

    Those still under way at its end do not count.

    Returns:
        Their rows of /delay_estimate, and the key in `ENDS` of each, shape (n,).
    """
    made, arrived = flight.during("/delay_estimate"), flight.during("/downlink_delay")
    numbers, arrivals = datagrams(made), datagrams(arrived)
    if not len(arrivals):
        return select(made, np.zeros(0, int)), np.zeros(0, "U1")
    is_followed = np.isin(numbers, datagrams(flight.recording["/command_applied"]))
    rows = np.flatnonzero(~is_followed & (numbers <= arrivals.max()))
    numbers = numbers[rows]
    _, first = np.unique(arrivals, return_index=True)
    has_come, source = join(numbers, arrivals[first])
    at, was_used = first[source], arrived["used"][first[source]]
    newest = np.maximum.accumulate(arrivals)
    guard = flight.recording["/guard"]
    state = guard["state"][guard["stamp_ns"].searchsorted(arrived["stamp_ns"][at], "right") - 1]
    is_old = np.where(was_used, state == GuardState.TRACK, newest[at] > arrivals[at])
    ended = np.where(made["counter"][rows] == UNSENT, "withheld", "lost").astype("U10")
    ended[has_come] = np.where(is_old, "superseded", "guard")
    return select(made, rows), ended


def _scans_of(flight: Flight, method: str) -> Budget | None:
    """Cut the scans on which the robot acted into their stages; None without any.

    `method` is that of `_cut`.
    """
    seen, applied = acted(flight)
    numbers = datagrams(applied)
    if not len(numbers):
        return None
    done_ns = seen["stamp_ns"] - seen["hold_ns"]
    begun_ns = done_ns - seen["compute_ns"]
    arrived_ns = begun_ns - seen["wait_ns"]
    made = [each.name for each in STAGES].index("queue") + 1
    sent, stamps_ns = flight.recording["/frame"], seen["seen_stamp_ns"]
    pictures, rows = join(stamps_ns, sent["taken_ns"])
    sent_ns = np.full(len(stamps_ns), UNKNOWN_NS)
    sent_ns[pictures] = sent["stamp_ns"][rows]
    stages = (
        _stage("frame_encode", lambda _: sent_ns, is_extra=True),
        _stage("scan_uplink", lambda _: arrived_ns, at_cloud=True),
        _stage("scan_wait", lambda _: begun_ns, at_cloud=True),
        _stage("scan_compute", lambda _: done_ns, at_cloud=True),
        _stage("scan_hold", lambda c: c.at("/delay_estimate", c.numbers), at_cloud=True),
        *STAGES[made:],
    )
    commands = Commands(flight, numbers, stamps_ns)
    found = _cut(stages, commands, len(numbers), method)
    return found._replace(numbers=numbers, ended=np.full(len(numbers), ""))


def _cut(all_stages: Sequence[Stage], commands: Commands, count: int, method: str) -> Budget:
    """Cut commands into stages; a stage of which nothing is known is a part of the next one.

    The robot followed the first `count` of them. `method` tells how cloud's stamps were converted
    to world's clock.
    """
    stages, cuts, parts = list[Stage](), [commands.basis_ns], list[Stage]()
    notes = list[str]()
    for stage in all_stages:
        end_ns = stage.end(commands)
        is_known = end_ns != UNKNOWN_NS
        if not is_known[:count].any():
            parts += [stage] * (not stage.is_extra)
            continue
        if stage.is_extra:
            end_ns = np.where(is_known, end_ns, cuts[-1])
        stages.append(_together([*parts, stage]))
        cuts.append(end_ns)
        notes += [ONE_END] * bool(parts)
        parts = []
    found = Budget(tuple(stages), np.array(cuts), notes=tuple(dict.fromkeys(notes)))
    return _on_one_clock(found, method)


def _together(parts: Sequence[Stage]) -> Stage:
    name, text = "_and_".join(each.name for each in parts), " + ".join(each.text for each in parts)
    return parts[-1]._replace(name=name, text=text)


def _on_one_clock(found: Budget, method: str) -> Budget:
    """Put the stamps of cloud's clock between those of world's clock before and after them.

    If the clocks are not in common, both directions of the link become one stage: one clock tells
    how long cloud had a command, and the other clock how long it was away.
    """
    rows = [row for row, stage in enumerate(found.stages, start=1) if stage.at_cloud]
    if not rows or rows[-1] == len(found.stages):
        return found
    first, last, ns = rows[0], rows[-1], found.ns.copy()
    whole = (ns != UNKNOWN_NS).all(axis=0)
    inside = ns[first - 1 : last + 1, whole]
    ordered = np.minimum(np.maximum.accumulate(inside)[1:], ns[last + 1, whole])
    astray = (abs(ordered - inside[1:]) > ASTRAY_NS).any(axis=0)
    if method != "first records" and astray.sum() <= ASTRAY_MAX * len(astray):
        ns[first : last + 1, whole] = ordered
        return found._replace(ns=ns)
    ns[first : last + 1, whole] += ns[last + 1, whole] - ns[last, whole]
    stages = [*found.stages]
    stages[first - 1 : first] = [_together([stages[first - 1], stages.pop(last)])]
    notes = (*found.notes, NO_CLOCK)
    return found._replace(stages=tuple(stages), ns=np.delete(ns, last + 1, axis=0), notes=notes)


def _mean(name: str, flight: Flight) -> float | None:
    found = budget_of(flight)
    if name in SCAN_STAGES and found.scans:
        found = found.scans
    for stage, length_ns in zip(found.stages, np.diff(found.followed, axis=0), strict=True):
        if stage.name == name and len(length_ns):
            return summary(length_ns)["mean"]
    return None


NAMES = *AGE_STAGES, *SCAN_STAGES
"""Names of all stages."""
add_measures(*((f"{NUMBER}{name}", partial(_mean, name)) for name in NAMES))
