# SPDX-License-Identifier: Apache-2.0

"""Define the quantities that a flight's report, its live metrics and the console all show.

`QUANTITIES` has a row for each quantity with a value per record: the row is all that report, rows
of sweeps, Prometheus, dashboard, console and documentation need. The other quantities depend on
several records.

Each quantity is computed step by step. Live metrics and console do so while the records arrive, the
report does so afterwards, with the same functions. So the same records give the same value, except
for two quantities of which the report knows more: it waits longer for a missing datagram before
it counts the datagram as lost (`link.WINDOW_MAX`), and it knows the true positions
(`PredictionJudge`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from heapq import heappop, heappush
from math import nan
from typing import Any, Literal

from cloudrc.wire.messages import Cause, GuardState, Vector
from cloudrc.wire.records import Arrival, Control, GroundTruth

# Delays. Stamps are subtracted only from stamps of the same clock.


def age(now_ns: Any, stamp_ns: Any) -> Any:
    """Return the age of information [s]: the time from its stamp to `now_ns`, both [ns].

    Both are numbers or arrays, on one clock.
    """
    return (now_ns - stamp_ns) * 1e-9


def target_ns(basis_stamp_ns: int, horizon: float) -> int:
    """Return the instant for which cloud predicted the robot's state [ns], world's clock.

    `basis_stamp_ns` is the stamp of the odometry [ns], `horizon` the time to predict ahead [s].
    """
    return basis_stamp_ns + round(horizon * 1e9)


def delay_error(horizon: Any, basis_stamp_ns: Any, applied_ns: Any) -> Any:
    """Return how wrong a delay estimate was: estimated minus true delay [s].

    The estimate is the `horizon` [s] of a command. The true delay is the time from the stamp of the
    odometry that the command is based on, `basis_stamp_ns`, to the command's application at
    `applied_ns` [ns], both on world's clock. All are numbers or arrays.
    """
    return horizon - age(applied_ns, basis_stamp_ns)


class Echoes:
    """Finds the control periods in which cloud measured a new round trip.

    All other periods repeat the last measured values, for seconds on end if the link is silent. If
    several echoes arrive in one period, the period has the values of the last one.
    """

    def __init__(self) -> None:
        self._last = nan, nan

    def take(self, rtt: float, loop_delay: float) -> bool:
        """Return whether a period with `rtt` [s] and `loop_delay` [s] has a new round trip."""
        known = rtt, loop_delay
        is_new = rtt == rtt and known != self._last
        self._last = known
        return is_new


# Errors.


def tracking_error(setpoint: Iterable[Any], position: Iterable[Any]) -> tuple[Any, Any, Any]:
    """Return `setpoint` minus `position` [m], x, y and z, each a number or an array."""
    (sx, sy, sz), (x, y, z) = setpoint, position
    return sx - x, sy - y, sz - z


def prediction_error(
    predicted: Iterable[Any], before: Iterable[Any], after: Iterable[Any], share: Any
) -> tuple[Any, Any, Any]:
    """Return a predicted position minus the position between two known ones [m].

    Each position has x, y and z, each a number or an array. `share` [1] of the way from `before` to
    `after` is flown.
    """
    (px, py, pz), (ax, ay, az), (bx, by, bz) = predicted, before, after
    x = px - ax - share * (bx - ax)
    y = py - ay - share * (by - ay)
    z = pz - az - share * (bz - az)
    return x, y, z


@dataclass(frozen=True, slots=True)
class RecordQuantity:
    """A quantity with a value for each record of a class, and where people see it.

    Its number is in report, page, sweeps and `cloudrc list metrics`, its newest value in flight.
    """

    source: type[Any]  # class of the records; not `Arrival`, which two ends make
    # Value of a record, or of all rows of a flight as one record: its fields are then arrays.
    # A vector is a tuple of x, y and z; all other values are numbers or arrays.
    value: Callable[[Any], Any]
    unit: str  # SI unit as text; "1" for counts and shares
    name: str = ""  # of its number, in report.json; "": none
    statistic: Literal["mean", "rms", "p95", "p99", "max"] = "mean"  # number over a flight
    meaning: str = ""  # of its number, one sentence
    group: str = "Estimation and tracking"  # title above its number in report.html
    label: str = ""  # of its number in the summary of a report; "": not there
    live: str = ""  # name of its Prometheus metric, with [axis] for a vector; "": none
    now: str = ""  # meaning of the metric, one sentence
    panel: str = ""  # title of its panel in the dashboard; "": none
    # Chart of the console: title, factor from the SI unit, and smallest range of its axis. Only for
    # records that telemetry's reader gets, `Control`.
    chart: tuple[str, float, float] | None = None


QUANTITIES = (
    RecordQuantity(
        GroundTruth,
        lambda row: row.position,
        "m",
        live="cloudrc_position_meters[axis]",
        now="True position of the base, world frame.",
    ),
    RecordQuantity(
        GroundTruth,
        lambda row: row.velocity,
        "m/s",
        "speed_max",
        "max",
        "Largest true speed of the robot's base.",
        "Mission",
    ),
    RecordQuantity(
        Control,
        lambda row: row.horizon,
        "s",
        live="cloudrc_delay_estimate_seconds",
        now="Clamped delay estimate: how far ahead cloud predicts the odometry.",
    ),
    RecordQuantity(
        Control,
        lambda row: tracking_error(row.setpoint, row.measured),
        "m",
        "tracking_rms_measured",
        "rms",
        "RMS distance between the setpoint and the measured position that cloud used.",
        live="cloudrc_tracking_error_meters[axis]",
        now="Setpoint minus measured position, in the newest period.",
        chart=("Tracking error [m]", 1.0, 0.2),
    ),
    RecordQuantity(
        Control,
        lambda row: tracking_error(row.setpoint, row.position),
        "m",
        "tracking_rms_estimated",
        "rms",
        "RMS distance between the setpoint and cloud's estimated position.",
    ),
    RecordQuantity(
        Control,
        lambda row: row.setpoint,
        "m",
        live="cloudrc_setpoint_meters[axis]",
        now="Position setpoint, world frame.",
    ),
    RecordQuantity(
        Control,
        lambda row: row.command,
        "m/s",
        live="cloudrc_command_velocity_meters_per_second[axis]",
        now="Commanded velocity, world frame.",
    ),
    RecordQuantity(
        Control,
        lambda row: row.yaw_rate,
        "rad/s",
        live="cloudrc_command_yaw_rate_radians_per_second",
        now="Commanded yaw rate.",
    ),
)
CHARTED = tuple(each for each in QUANTITIES if each.chart)
"""Quantities with a chart in the console."""


GAP_MAX_NS = 50_000_000
"""Longest time between two known positions between which positions are interpolated [ns]."""
WAITING_MAX = 256
"""Largest number of stored predictions or commands; 100 are enough for delays of 1 s."""
LONG_AGO_NS = -(1 << 62)
"""Stamp of the position that is known before the first one [ns]."""


class PredictionJudge:
    """Compares predicted positions with the position that was known later for the same instant.

    Live metrics and the console do so with measured positions, the report with true positions
    (`metrics.control.compare_with_truth`). Between two known positions, the position is
    interpolated linearly.

    Attributes:
        error: Newest error: predicted minus known position [m]; NaN before the first.
        square: Sum of the squared lengths of all errors [m^2].
        judged: Number of compared predictions.
    """

    def __init__(self) -> None:
        self.error: Vector = (nan, nan, nan)
        self.square = 0.0
        self.judged = 0
        self.reset()

    def reset(self) -> None:
        """Drop all predictions and positions, because a new session has started."""
        self._waiting: list[tuple[int, Vector]] = []
        self._known_ns = LONG_AGO_NS
        self._known: Vector = (nan, nan, nan)

    def take(self, control: Control) -> None:
        """Judge predictions for times up to a new measurement; store the new prediction."""
        self.know(control.basis_stamp_ns, control.measured)
        at_ns = target_ns(control.basis_stamp_ns, control.horizon)
        self.predict(at_ns, control.position)

    def predict(self, at_ns: int, position: Vector) -> None:
        """Store the `position` [m] predicted for the instant `at_ns` [ns]."""
        if len(self._waiting) < WAITING_MAX:
            heappush(self._waiting, (at_ns, position))

    def know(self, stamp_ns: int, position: Vector) -> None:
        """Judge the predictions for instants up to `stamp_ns` [ns], with its known position [m]."""
        waiting, before_ns = self._waiting, self._known_ns
        if stamp_ns <= before_ns:
            return
        before, self._known_ns, self._known = self._known, stamp_ns, position
        while waiting and waiting[0][0] <= stamp_ns:
            at_ns, predicted = heappop(waiting)
            if before_ns <= at_ns and stamp_ns - before_ns <= GAP_MAX_NS:
                share = (at_ns - before_ns) / (stamp_ns - before_ns)
                self.error = x, y, z = prediction_error(predicted, before, position, share)
                self.square += x * x + y * y + z * z
                self.judged += 1


class DelayJudge:
    """Compares delay estimates with true delays, which echoes show in flight.

    Cloud computes each command from an odometry sample. The delay is the time from the stamp of
    this sample until world applies the command. Telemetry contains an echo of the newest command
    that world has applied: the command's stamp on cloud's clock, and the time since then.
    """

    def __init__(self) -> None:
        self.error = nan  # newest error: estimated minus true delay [s]
        self.reset()

    def reset(self) -> None:
        """Drop the records of commands without an echo, because a new session has started."""
        self._sent: dict[int, Control] = {}

    def sent(self, control: Control) -> None:
        """Store the record of a sent command; its echo will show the true delay."""
        self._sent[control.stamp_ns] = control
        if len(self._sent) > WAITING_MAX:
            del self._sent[next(iter(self._sent))]  # the oldest

    def echoed(self, telemetry: Arrival, stamp_ns: int) -> None:
        """Compute how wrong the estimated delay was for the command that `telemetry` echoes.

        `stamp_ns` is the stamp of this telemetry's odometry [ns], world's clock.
        """
        if sent := self._sent.get(telemetry.echo_stamp_ns):
            applied_ns = stamp_ns - telemetry.echo_hold_ns
            self.error = delay_error(sent.horizon, sent.basis_stamp_ns, applied_ns)


# Lost datagrams.

WINDOW = 128
"""In flight, a missing datagram counts as lost after this number of newer datagrams: 1.28 s at 100
Hz, so that a loss shows soon."""
ALL_SEEN = (1 << WINDOW) - 1


class DatagramTally:
    """Counts lost and reordered datagrams of one direction of the link.

    The sender numbers datagrams by a counter, which restarts in each epoch (session).

    Attributes:
        lost: Number of datagrams that had not arrived when the peer had sent `WINDOW` newer ones.
        reordered: Number of datagrams that arrived after a newer one, without repetitions.
    """

    def __init__(self) -> None:
        self.lost = self.reordered = 0
        self._before = 0  # value of `expected` at the end of the last epoch
        self._epoch = self._first = self._newest = -1
        self._seen = ALL_SEEN  # bit k: the datagram with the counter newest - k has arrived

    @property
    def expected(self) -> int:
        """Number of datagrams for which the receiver no longer waits: arrived or lost."""
        return self._before + max(0, self._newest - self._first - WINDOW + 1)

    def take(self, epoch: int, counter: int) -> bool:
        """Count the arrival of a datagram; return True if the datagram is certainly new.

        Return False for a repeated or very old datagram: an attacker may have sent it again.
        """
        if epoch != self._epoch:
            # Datagrams before the first arrival are not lost: the receiver may not have run.
            self._before = self.expected
            self._epoch, self._first, self._newest = epoch, counter, counter - 1
            self._seen = ALL_SEEN
        ahead = counter - self._newest
        if ahead > 0:  # the skipped datagrams are lost or late
            leaving = min(ahead, WINDOW)
            self.lost += ahead - (self._seen >> (WINDOW - leaving)).bit_count()
            self._seen = (self._seen << ahead | 1) & ALL_SEEN if ahead < WINDOW else 1
            self._newest = counter
        elif ahead > -WINDOW and not self._seen >> -ahead & 1:
            self._seen |= 1 << -ahead
            self.reordered += 1
        else:
            return False
        return True


# Time.


class Holds:
    """Measures the HOLDs that interrupt a mission's flight.

    Such a HOLD follows TRACK, and its cause is not the end of the mission. It lasts until the next
    change of the guard, or until the mission ends.

    Attributes:
        count: Number of these HOLDs.
    """

    def __init__(self) -> None:
        self.count = 0
        self._state = GuardState.GROUND
        self._since_ns: int | None = None  # start of the present HOLD
        self._over_ns = 0  # total time in the earlier ones

    def take(self, stamp_ns: int, state: GuardState, cause: str) -> list[tuple[int, int]]:
        """Process a change of the guard at `stamp_ns` [ns], with the words of its cause.

        Return start and end [ns] of the HOLD that this change ends, if any.
        """
        over = self.end(stamp_ns)
        interrupts = self._state == GuardState.TRACK and cause != Cause.ENDED.words
        if state == GuardState.HOLD and interrupts:
            self.count += 1
            self._since_ns = stamp_ns
        self._state = state
        return over

    def end(self, now_ns: int) -> list[tuple[int, int]]:
        """End the mission at `now_ns` [ns]; return start and end [ns] of the HOLD that lasts."""
        if self._since_ns is None:
            return []
        since_ns, self._since_ns = self._since_ns, None
        self._over_ns += now_ns - since_ns
        return [(since_ns, now_ns)]

    def time(self, now_ns: int) -> float:
        """Return the total time in these HOLDs up to `now_ns` [s]; no change may be later."""
        present_ns = 0 if self._since_ns is None else now_ns - self._since_ns
        return (self._over_ns + present_ns) * 1e-9


def real_time_factor(simulated: float, slip: float) -> float:
    """Return simulated time divided by the time on the machine's clock; NaN if no time passed.

    Args:
        simulated: Time that passed on world's clock [any unit].
        slip: Time by which world's clock fell further behind the machine's clock [the same unit].
    """
    passed = simulated + slip
    return simulated / passed if passed > 0 else nan
