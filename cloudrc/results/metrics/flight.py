# SPDX-License-Identifier: Apache-2.0

"""Define `Flight`, a recording of one mission, and the metrics of the robot's motion.

A mission begins when world obeys the operator's request to start it; all times count from there.
The flight begins when the guard first changes to TRACK, because the robot does not move before.
Both end with the event that ends the mission or, without such an event, with the recording.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property, partial, reduce
from math import isfinite
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cloudrc.physics.geometry.clearance import Spheres, clearance, inside_tube, least_clearance
from cloudrc.physics.geometry.obstacles import Obstacle, has_surface, obstacles
from cloudrc.physics.geometry.scene import Scene
from cloudrc.results.metrics.counters import growth
from cloudrc.results.metrics.definitions import QUANTITIES, RecordQuantity
from cloudrc.results.metrics.descriptions import DESCRIPTIONS
from cloudrc.results.record.columns import Recording, Table, datagrams, join
from cloudrc.results.record.holes import Hole
from cloudrc.results.record.topics import BY_SOURCE
from cloudrc.wire.messages import GuardState
from cloudrc.wire.records import UNDER_WAY, Control, MissionEnd, Record

if TYPE_CHECKING:
    from cloudrc.config.schema import Criteria, MissionConfig

Array: TypeAlias = NDArray[Any]
Columns: TypeAlias = dict[str, Array]


@dataclass(frozen=True, eq=False)
class Flight:
    """A recorded flight, its criteria of success, its mission and its scene."""

    recording: Recording  # all topics; cloud's stamps are shifted to world's clock
    criteria: Criteria
    mission: MissionConfig  # with its waypoints or random steps
    scene: Scene  # its tubes and all other obstacles
    hull: Spheres | None = None  # of the robot; None: not known
    command_rate_hz: int = 100  # cloud.command_rate_hz
    copies: bool = False  # whether its tables may be changed: else they are those of the recording
    _during: dict[str, Columns] = field(default_factory=dict, init=False)  # of the topics asked for

    @cached_property
    def start_ns(self) -> int | None:
        """Start of the flight [ns], world's clock; None if the robot never flew."""
        guard = self.recording["/guard"]
        tracking = guard["stamp_ns"][guard["state"] == GuardState.TRACK]
        return int(tracking[0]) if len(tracking) else None

    @cached_property
    def mission_ns(self) -> int | None:
        """Start of the mission [ns], world's clock: its first telemetry; None if never flown.

        If the recording lacks this telemetry, the mission starts with the flight.
        """
        if self.start_ns is None:
            return None
        telemetry = self.recording["/telemetry"]
        before = telemetry["stamp_ns"] <= self.start_ns
        missions = telemetry["mission_id"][before]
        changes = np.flatnonzero(np.diff(missions))
        if len(changes):
            return int(telemetry["stamp_ns"][changes[-1] + 1])
        # In a session, the first telemetry may already be that of the first mission.
        is_lost = any(hole.begin_ns < self.start_ns for hole in self.recording.holes)
        is_first = len(missions) and missions[0] and not is_lost
        return int(telemetry["stamp_ns"][0]) if is_first else self.start_ns

    @cached_property
    def end_ns(self) -> int | None:
        """End of the flight [ns], world's clock; None if the robot never flew."""
        if self.start_ns is None or self.ending is not None:
            return self.ending[0] if self.ending else None
        stamps = self.recording["/ground_truth"]["stamp_ns"]
        return int(stamps[-1]) if len(stamps) else self.start_ns

    @cached_property
    def holes(self) -> tuple[Hole, ...]:
        """Times of the flight in which messages are lost."""
        if self.span_ns is None:
            return self.recording.holes
        return tuple(hole for hole in self.recording.holes if hole.meets(*self.span_ns))

    @property
    def duration(self) -> float:
        """Time from the start of the mission to its end [s]; 0 if the robot never flew."""
        return 0.0 if self.end_ns is None else float(self.seconds(self.end_ns))

    @cached_property
    def ending(self) -> tuple[int, MissionEnd, str] | None:
        """Event that ended the mission: stamp [ns], name, text; None if there is no such event."""
        if (start_ns := self.start_ns) is None:
            return None
        rows = rows_of(self.recording["/mission"], "stamp_ns", "event", "text")
        return next((row for row in rows if row[0] > start_ns and row[1] not in UNDER_WAY), None)

    def seconds(self, stamp_ns: Any) -> Any:
        """Convert stamps on world's clock [ns] to times since the start of the mission [s]."""
        return (stamp_ns - (self.mission_ns or 0)) * 1e-9

    def during(self, topic: str) -> Columns:
        """Select the rows of a topic from the first to the last instant of the flight."""
        if topic not in self._during:  # fifty metrics ask for ten topics
            self._during[topic] = _flown(self, self.recording[topic].columns)
        return self._during[topic]

    def true_position(self, stamp_ns: Array) -> Array:
        """Interpolate the base's true position at `stamp_ns` [ns], world's clock, shape (n,).

        Returns:
            Positions [m], shape (n, 3); NaN before and after the recording, and in its holes.
        """
        truth = self.recording["/ground_truth"]
        stamps, positions = truth["stamp_ns"], truth["position"]
        if len(stamps) == 0:
            return np.full((len(stamp_ns), 3), np.nan)
        # Differences to the first stamp are exact in float64; the stamps themselves may not be.
        at, known = (stamp_ns - stamps[0]).astype(float), (stamps - stamps[0]).astype(float)
        axes = [np.interp(at, known, positions[:, i], np.nan, np.nan) for i in range(3)]
        found = np.stack(axes, axis=1)
        for hole in self.recording.holes:
            found[(stamp_ns > hole.begin_ns) & (stamp_ns < hole.end_ns)] = np.nan
        return found

    @cached_property
    def position_noise(self) -> float:
        """Root mean square per axis of the error of the measured positions [m]; 0 if unknown."""
        measured = self.during("/odometry")
        errors = measured["position"] - self.true_position(measured["stamp_ns"])
        known = errors[np.isfinite(errors).all(axis=1)]
        return float(np.sqrt(np.mean(known**2))) if len(known) else 0.0

    @cached_property
    def truth(self) -> Columns:
        """True states of the robot during the flight."""
        return self.during("/ground_truth")

    @cached_property
    def control(self) -> Columns:
        """One row per control period of the flight, with the columns of all its topics."""
        return _flown(self, self._control)

    @cached_property
    def _control(self) -> Columns:
        return _joined(self.recording, Control)

    def rows(self, source: type[Record]) -> Any:
        """Return the flight's records of a class as one record, whose fields are arrays.

        A vector is a tuple of x, y and z.
        """
        columns = _flown(self, _joined(self.recording, source)).items()
        return SimpleNamespace(
            **{name: tuple(values.T) if values.ndim > 1 else values for name, values in columns}
        )

    @cached_property
    def clearance(self) -> Array:
        """Distance to the nearest obstacle [m], per row of `truth`; empty without obstacles."""
        if self.hull is None or not self.obstacles or not len(self.truth["stamp_ns"]):
            return np.zeros(0)
        poses = self.truth["position"], self.truth["orientation_wxyz"]
        return clearance(self.obstacles, *poses, self.hull)

    @cached_property
    def obstacles(self) -> tuple[Obstacle, ...]:
        """All bodies that the robot must not touch, and from which clearances are known."""
        return tuple(filter(has_surface, obstacles(self.scene, touch=self.mission.touched)))

    @cached_property
    def first_touch(self) -> Columns | None:
        """First row of /contact in which the robot touches what it has to; None if it never did."""
        contact = self.during("/contact")
        of_probe = contact["by_probe"].astype(bool)
        touches = np.flatnonzero((contact["body"] == self.mission.touched) & of_probe)
        return select(contact, touches[0]) if len(touches) else None

    def count(self, number: float) -> float | None:
        """Return `number` [any unit] as the value of a metric; None if the robot never flew."""
        return None if self.start_ns is None else float(number)

    @property
    def span_ns(self) -> tuple[int, int] | None:
        """Start and end of the flight [ns], world's clock; None if the robot never flew."""
        if self.start_ns is None or self.end_ns is None:
            return None
        return self.start_ns, self.end_ns

    def growth(self, name: str) -> float | None:
        """Return by how much a counter rose in the flight [1]; None if it was never recorded.

        If the robot never flew, the whole recording counts.
        """
        return growth(self.recording, name, self.span_ns)

    @cached_property
    def applied(self) -> Columns:
        """Commands that world applied in the flight, each with cloud's record `Control`.

        Commands without such a record are left out. `stamp_ns` is the time of application or, for a
        command with a plan, the start of the plan [ns]; `position` is the predicted position [m].
        """
        commands = self.during("/command_applied")
        known, source = join(datagrams(commands), datagrams(self._control))
        columns = select(self._control, source) | select(commands, known)
        planned, stamp = columns["planned_ns"], columns["stamp_ns"]
        return columns | {"stamp_ns": np.where(planned >= 0, planned, stamp)}


def _joined(recording: Recording, source: type[Record]) -> Columns:
    """Return the columns of all topics in whose rows the records of a class are."""
    tables = [recording[topic.name].columns for topic in BY_SOURCE[source]]
    times_ns = [table["stamp_ns"] for table in tables]
    # In the last period of a torn recording some topics may be missing.
    if not all(np.array_equal(times_ns[0], each) for each in times_ns):
        stamps = reduce(np.intersect1d, times_ns)
        tables = [select(table, np.searchsorted(table["stamp_ns"], stamps)) for table in tables]
    return {name: column for table in tables for name, column in table.items()}


def _flown(flight: Flight, columns: Columns) -> Columns:
    """Select the rows in the time of a flight."""
    found = between(columns, *(flight.span_ns or (0, -1)))
    return {name: column.copy() for name, column in found.items()} if flight.copies else found


def yaw_of(orientations_wxyz: Array) -> Array:
    """Return the yaws of n orientations [rad], shape (n,).

    `orientations_wxyz` are unit quaternions [1], body to world, shape (n, 4).
    """
    w, x, y, z = orientations_wxyz.T
    yaws: Array = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return yaws


def turn_between(start: Array, end: Array | float) -> Array:
    """Return the shortest turns from the yaws `start` to `end`, in [rad], from -pi to pi."""
    turns: Array = np.remainder(end - start + np.pi, 2.0 * np.pi) - np.pi
    return turns


def rows_of(columns: Columns | Table, *names: str) -> Iterator[Any]:
    """Yield the rows of some columns, in the types of Python."""
    return zip(*(columns[name].tolist() for name in names), strict=True)


def select(columns: Columns, rows: Array) -> Columns:
    """Select rows of all columns by `rows` [1]: an index, indices, or a truth value per row."""
    return {name: column[rows] for name, column in columns.items()}


def between(columns: Columns, first_ns: float, last_ns: float) -> Columns:
    """Select the rows with stamps from `first_ns` to `last_ns` [ns]."""
    stamps_ns = columns["stamp_ns"]
    inside = (stamps_ns >= first_ns) & (stamps_ns <= last_ns)
    first, count = int(inside.argmax()) if len(inside) else 0, int(np.count_nonzero(inside))
    if inside[first : first + count].all():  # nearly always: then no column is copied
        return {name: column[first : first + count] for name, column in columns.items()}
    return select(columns, inside)


Measure: TypeAlias = Callable[[Flight], float | None]


@dataclass(frozen=True, slots=True)
class Metric:
    """A metric; `measure` returns its value in `unit`, or None if the value is unknown."""

    name: str  # in report.json
    unit: str  # SI unit as text; "1" for counts and shares
    meaning: str  # one sentence
    measure: Measure
    group: str = "Others"  # title above the metric in report.html
    label: str = ""  # in the summary of a report; "": not there


SHIPPED: dict[str, Metric] = {}
"""The metrics of cloudrc by name; complete once `cloudrc.results.metrics.measure` is imported."""


def add_measures(*rows: tuple[Any, ...]) -> None:
    """Add metrics of cloudrc; each row has a name of `DESCRIPTIONS` and a function.

    A row may also name a key of `STATISTICS`: its function then returns an array of a flight.
    """
    for name, measure, *statistic in rows:
        if statistic:
            measure = partial(_summarize, measure, *statistic)
        unit, meaning, group, label = DESCRIPTIONS[name]
        SHIPPED[name] = Metric(name, unit, meaning, measure, group, label)


def _summarize(values: Callable[[Flight], Array], statistic: str, flight: Flight) -> float | None:
    found = values(flight)
    if statistic != "rms" and found.ndim > 1:
        found = np.linalg.norm(found, axis=1)
    return STATISTICS[statistic](found)


def add_quantities() -> None:
    """Add the metrics of `QUANTITIES`."""
    for each in QUANTITIES:
        if each.name:
            add_measures((each.name, partial(_values, each), each.statistic))


def _values(quantity: RecordQuantity, flight: Flight) -> Array:
    """Return a quantity in each row of a flight, shape (n,) or, of vectors, (n, 3)."""
    found = quantity.value(flight.rows(quantity.source))
    return np.stack(found, axis=1) if isinstance(found, tuple) else np.asarray(found)


def finite(value: float) -> float | None:
    """Return `value` [any unit] as the value of a metric; None if it is NaN or infinite."""
    return float(value) if isfinite(value) else None


def mean(values: Array) -> float | None:
    """Average the finite `values`, shape (n,), any unit; None if no value is finite."""
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else None


def percentile(values: Array, percent: float) -> float | None:
    """Return the percentile `percent` [%] of the finite `values`, shape (n,).

    Return None if no value is finite.
    """
    finite = values[np.isfinite(values)]
    return float(np.percentile(finite, percent)) if len(finite) else None


def rms(errors: Array) -> float | None:
    """Compute the root mean square length of the vectors `errors`, shape (n,) or (n, 3), any unit.

    Rows with NaN or infinity are left out; return None if no row is left.
    """
    squares = np.square(errors) if errors.ndim == 1 else np.square(errors).sum(axis=1)
    square = mean(squares)
    return None if square is None else float(np.sqrt(square))


STATISTICS: dict[str, Callable[[Array], float | None]] = {
    "mean": mean,
    "rms": rms,
    "p95": partial(percentile, percent=95.0),
    "p99": partial(percentile, percent=99.0),
    "max": partial(percentile, percent=100.0),
}


def _least_clearance(flight: Flight, *, inside: bool) -> float | None:
    truth = flight.truth
    if flight.hull is None:
        return None
    rows = inside_tube(flight.scene, truth["position"]) if inside else slice(None)
    poses = truth["position"][rows], truth["orientation_wxyz"][rows]
    found = least_clearance(flight.obstacles, *poses, flight.hull)
    return finite(found)


def _distance(flight: Flight) -> float | None:
    steps = np.diff(flight.truth["position"], axis=0)
    return float(np.linalg.norm(steps, axis=1).sum()) if len(steps) else None


add_measures(
    ("duration", lambda flight: flight.count(flight.duration)),
    ("start_delay", lambda flight: flight.start_ns and float(flight.seconds(flight.start_ns))),
    ("distance_flown", _distance),
    ("min_clearance", partial(_least_clearance, inside=True)),
    ("min_clearance_flight", partial(_least_clearance, inside=False)),
)
