"""What cloud exposes besides what both ends do: delays in the loop, prediction, control."""

from __future__ import annotations

from math import nan

from cloudrc.exposition.end import End
from cloudrc.exposition.histogram import Histogram
from cloudrc.exposition.judge import DelayJudge, PredictionJudge
from cloudrc.exposition.labels import AXES, DELAY_BUCKETS, DIRECTIONS, PLUGINS, TERMS
from cloudrc.exposition.part import Handlers, Readings, known, per_axis, plain
from cloudrc.messages import NEVER_NS, Vector
from cloudrc.records import Arrival, Control, SessionOpened


class CloudEnd(End):
    """The remote controller's end."""

    def __init__(self) -> None:
        """Begin with nothing measured."""
        uplink, downlink = DIRECTIONS
        super().__init__(incoming=uplink, outgoing=downlink)
        self._rtt, self._loop = Histogram(DELAY_BUCKETS), Histogram(DELAY_BUCKETS)
        self._prediction, self._delay = PredictionJudge(), DelayJudge()
        self._control: Control | None = None
        self._loop_delay = nan
        self._used_ns, self._used_count = NEVER_NS, 0

    def handlers(self) -> Handlers:
        """See `Part`."""
        return {**super().handlers(), Control: self._see_control}

    def _see_session(self, record: SessionOpened) -> None:
        super()._see_session(record)
        self._prediction.reset()
        self._delay.reset()

    def _see_arrival(self, record: Arrival) -> None:
        super()._see_arrival(record)
        if record.used:
            self._used_count += 1

    def _see_control(self, record: Control) -> None:
        self._control = record
        self._see_age(record.stamp_ns)
        self._prediction.take(record)
        loop_delay = record.loop_delay
        if loop_delay != self._loop_delay and loop_delay == loop_delay:  # a new echo
            self._loop_delay = loop_delay
            self._loop.observe(loop_delay)
            self._rtt.observe(record.rtt)
            if self._used_count == 1:  # of two odometries nobody can say which one echoed
                self._delay.echoed(record, self._newest_ns)
        self._used_count = 0
        self._delay.sent(record)

    def read(self) -> Readings:
        """See `Part`."""
        counts, prediction = self._counts, self._prediction
        readings = super().read()
        readings |= {
            "cloudrc_rtt_seconds": self._rtt,
            "cloudrc_loop_delay_seconds": self._loop,
            "cloudrc_delay_estimate_error_seconds": known(self._delay.error),
            "cloudrc_prediction_error_meters": per_axis(prediction.error),
            "cloudrc_prediction_error_square_meters_total": plain(prediction.square),
            "cloudrc_predictions_judged_total": plain(prediction.judged),
            "cloudrc_horizon_clamped_total": plain(counts.get("horizon_clamped", 0)),
            "cloudrc_commands_frozen_total": plain(counts.get("frozen", 0)),
            "cloudrc_words_dropped_total": plain(counts.get("words_dropped", 0)),
            "cloudrc_loop_missed_periods_total": plain(counts.get("missed_periods", 0)),
            "cloudrc_plugin_failures_total": {
                (plugin,): counts.get(f"{plugin}_failed", 0) for plugin in PLUGINS
            },
        }
        return readings if self._control is None else readings | _of_period(self._control)


def _of_period(control: Control) -> Readings:
    """What the newest period of the control loop says."""
    terms = (control.proportional, control.integral, control.derivative)
    return {
        "cloudrc_delay_estimate_seconds": known(control.horizon),
        "cloudrc_tracking_error_meters": per_axis(_minus(control.setpoint, control.measured)),
        "cloudrc_setpoint_meters": per_axis(control.setpoint),
        "cloudrc_command_velocity_meters_per_second": per_axis(control.command),
        "cloudrc_command_yaw_rate_radians_per_second": known(control.yaw_rate),
        "cloudrc_pid_output": {
            (axis, name): term[index]
            for name, term in zip(TERMS, terms, strict=True)
            for index, axis in enumerate(AXES)
        },
    }


def _minus(one: Vector, other: Vector) -> Vector:
    return (one[0] - other[0], one[1] - other[1], one[2] - other[2])
