"""Define `Flight`, a recording cut to its mission, and the metrics of the robot's motion.

All stamps are on world's clock. Time zero is the guard's first change to TRACK; the robot does not
move before. The flight ends with the event that ends the mission or, without such an event, at the
end of the recording.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, reduce
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cloudrc.config.schema import Criteria
from cloudrc.geometry.clearance import clearance, pipe_index
from cloudrc.geometry.scene import Scene
from cloudrc.messages import GuardState
from cloudrc.record.columns import Recording, Table
from cloudrc.records import UNDER_WAY

Array: TypeAlias = NDArray[Any]
Columns: TypeAlias = Mapping[str, Array]

CONTROL_TOPICS = (
    "/estimated_odometry",
    "/setpoint_position",
    "/cmd_vel",
    "/delay_estimate",
    "/pid",
)
"""Topics that together record the periods of the control loop."""


@dataclass(frozen=True, slots=True)
class AppliedCommands:
    """Commands that the low-level controller applied, joined with their control periods; n rows.

    Attributes:
        stamp_ns: Instant of application [ns], world's clock, shape (n,).
        basis_stamp_ns: Stamp of the odometry behind the command [ns], world's clock, shape (n,).
        horizon: Time from that odometry to the instant that cloud predicted [s], shape (n,).
        predicted: Position that cloud predicted [m], shape (n, 3).
    """

    stamp_ns: Array
    basis_stamp_ns: Array
    horizon: Array
    predicted: Array


@dataclass(frozen=True)
class Flight:
    """A recorded flight, its criteria and its scene.

    Attributes:
        recording: All topics; cloud's stamps are shifted to world's clock.
        criteria: Criteria of success.
        waypoints: Number of waypoints of the mission.
        scene: Pipes and board.
    """

    recording: Recording
    criteria: Criteria
    waypoints: int
    scene: Scene

    @cached_property
    def start_ns(self) -> int | None:
        """Time zero [ns], world's clock; None if the robot never flew."""
        guard = self.recording["/guard"]
        tracking = guard["stamp_ns"][guard["state"] == GuardState.TRACK]
        return int(tracking[0]) if len(tracking) else None

    @cached_property
    def end_ns(self) -> int | None:
        """Stamp of the end [ns], world's clock; None if the robot never flew.

        The end is the event that ended the mission or, without such an event, the last true state.
        """
        if self.start_ns is None:
            return None
        if self.ending is not None:
            return self.ending[0]
        stamps = self.recording["/ground_truth"]["stamp_ns"]
        return int(stamps[-1]) if len(stamps) else self.start_ns

    @cached_property
    def ending(self) -> tuple[int, str, str] | None:
        """Stamp [ns], name and text of the event that ended the mission; None without an end."""
        mission = self.recording["/mission"]
        rows = zip(mission["stamp_ns"], mission["event"], mission["text"], strict=True)
        for stamp, event, text in rows:
            if self.start_ns is not None and stamp > self.start_ns and event not in UNDER_WAY:
                return int(stamp), str(event), str(text)
        return None

    def seconds(self, stamp_ns: Any) -> Any:
        """Convert stamps on world's clock [ns] to time since the start [s]."""
        return (stamp_ns - (self.start_ns or 0)) * 1e-9

    def during(self, topic: str) -> dict[str, Array]:
        """Select the rows of a topic from the start to the end of the flight, both included."""
        return _within(_columns(self.recording[topic]), self.start_ns, self.end_ns)

    def true_position(self, stamp_ns: Array) -> Array:
        """Interpolate the true position of the base.

        Args:
            stamp_ns: Instants [ns], world's clock, shape (n,).

        Returns:
            Positions [m], shape (n, 3); NaN outside the recording.
        """
        truth = self.recording["/ground_truth"]
        stamps, positions = truth["stamp_ns"], truth["position"]
        if len(stamps) == 0:
            return np.full((len(stamp_ns), 3), np.nan)
        # Differences to the first stamp are exact in float64; the stamps themselves may not be.
        at, known = (stamp_ns - stamps[0]).astype(float), (stamps - stamps[0]).astype(float)
        axes = [np.interp(at, known, positions[:, i], np.nan, np.nan) for i in range(3)]
        return np.stack(axes, axis=1)

    @cached_property
    def truth(self) -> dict[str, Array]:
        """True states during the flight."""
        return self.during("/ground_truth")

    @cached_property
    def control(self) -> dict[str, Array]:
        """Periods of the control loop during the flight, joined from their topics."""
        return _within(self._control, self.start_ns, self.end_ns)

    @cached_property
    def _control(self) -> dict[str, Array]:
        tables = [_columns(self.recording[topic]) for topic in CONTROL_TOPICS]
        # In the last period of a torn recording some topics may be missing.
        stamps = reduce(np.intersect1d, [table["stamp_ns"] for table in tables])
        columns: dict[str, Array] = {}
        for table in tables:
            rows = np.searchsorted(table["stamp_ns"], stamps)
            columns |= {name: column[rows] for name, column in table.items()}
        return columns

    @cached_property
    def clearance(self) -> Array:
        """Distance to the nearest pipe wall [m] per row of `truth`; empty without pipes."""
        if not self.scene.pipes or not len(self.truth["stamp_ns"]):
            return np.zeros(0)
        return clearance(self.scene, self.truth["position"], self.truth["orientation_wxyz"])

    @cached_property
    def inside(self) -> Array:
        """Whether the base is inside a pipe, per row of `truth`; empty without pipes."""
        if not self.scene.pipes or not len(self.truth["stamp_ns"]):
            return np.zeros(0, dtype=bool)
        return pipe_index(self.scene, self.truth["position"]) >= 0

    @cached_property
    def pipes_flown(self) -> int:
        """Number of different pipes in which the base has been."""
        if not len(self.truth["stamp_ns"]):
            return 0
        indices = np.unique(pipe_index(self.scene, self.truth["position"]))
        return int((indices >= 0).sum())

    @cached_property
    def applied(self) -> AppliedCommands:
        """Commands applied during the flight whose control period was recorded."""
        applied, control = self.during("/command_applied"), self._control
        rows = {
            key: row
            for row, key in enumerate(zip(control["epoch"], control["counter"], strict=True))
        }
        keys = zip(applied["epoch"], applied["counter"], strict=True)
        joined = np.array([rows.get(key, -1) for key in keys], dtype=np.int64)
        source = joined[joined >= 0]
        return AppliedCommands(
            applied["stamp_ns"][joined >= 0],
            applied["basis_stamp_ns"][joined >= 0],
            control["horizon"][source],
            control["position"][source],
        )


def _columns(table: Table) -> dict[str, Array]:
    return {name: table[name] for name in table.names}


def _within(columns: Columns, start_ns: int | None, end_ns: int | None) -> dict[str, Array]:
    """Select the rows from `start_ns` to `end_ns`, both included; none without a start."""
    stamps = columns["stamp_ns"]
    if start_ns is None or end_ns is None:
        rows = np.zeros(len(stamps), dtype=bool)
    else:
        rows = (stamps >= start_ns) & (stamps <= end_ns)
    return {name: column[rows] for name, column in columns.items()}


@dataclass(frozen=True, slots=True)
class Metric:
    """A metric: one row of the tables in this package.

    Attributes:
        name: Name in report.json.
        unit: An SI unit as text: "s", "m", "m/s", "N"; "1" for counts and shares.
        meaning: One sentence for the report and for `cloudrc list metrics`.
        measure: Computes the number in `unit`; returns None if the number is unknown.
    """

    name: str
    unit: str
    meaning: str
    measure: Callable[[Flight], float | None]


def mean(values: Array) -> float | None:
    """Average the finite `values`, shape (n,), any unit; None if no value is finite."""
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else None


def percentile(values: Array, percent: float) -> float | None:
    """Compute a percentile; None if no value is finite.

    Args:
        values: Shape (n,), any unit; only finite values count.
        percent: Share of the values that are below the result [%].
    """
    finite = values[np.isfinite(values)]
    return float(np.percentile(finite, percent)) if len(finite) else None


def rms(errors: Array) -> float | None:
    """Compute the RMS length of error vectors.

    Args:
        errors: Shape (n,) or (n, 3), any unit; only finite rows count.

    Returns:
        RMS in the unit of `errors`; None if no row is finite.
    """
    squares = np.square(errors) if errors.ndim == 1 else np.square(errors).sum(axis=1)
    square = mean(squares)
    return None if square is None else float(np.sqrt(square))


def _duration(flight: Flight) -> float | None:
    return None if flight.end_ns is None else float(flight.seconds(flight.end_ns))


def _distance_flown(flight: Flight) -> float | None:
    steps = np.diff(flight.truth["position"], axis=0)
    return float(np.linalg.norm(steps, axis=1).sum()) if len(steps) else None


def _speed_max(flight: Flight) -> float | None:
    speeds = np.linalg.norm(flight.truth["velocity"], axis=1)
    return float(speeds.max()) if len(speeds) else None


def _min_clearance(flight: Flight) -> float | None:
    """Return the minimum clearance inside a pipe; negative if a wall was penetrated."""
    inside = flight.clearance[flight.inside]
    return float(inside.min()) if len(inside) else None


def _min_clearance_flight(flight: Flight) -> float | None:
    """Return the minimum clearance of all samples.

    The board does not count, because the arm must touch the board.
    """
    return float(flight.clearance.min()) if len(flight.clearance) else None


METRICS = (
    Metric("duration", "s", "Time from the start of the mission to its end.", _duration),
    Metric(
        "distance_flown", "m", "Length of the path that the robot's base flew.", _distance_flown
    ),
    Metric("speed_max", "m/s", "Largest true speed of the robot's base.", _speed_max),
    Metric(
        "min_clearance",
        "m",
        "Smallest distance between the robot and a pipe's wall while the base is inside a pipe.",
        _min_clearance,
    ),
    Metric(
        "min_clearance_flight",
        "m",
        "Smallest distance between the robot and a pipe during the whole flight.",
        _min_clearance_flight,
    ),
)
