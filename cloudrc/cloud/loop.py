"""The control loop: the newest telemetry becomes a command, through estimator, predictor, PID.

A plug-in may be wrong: it raises, or returns something that is not finite, or no numbers at all.
Then the loop does the careful thing (looks ahead by the last good horizon, uses the last sample,
commands zero), counts it, and says once what happened; it never stops.

While no echo shows that commands are flown, the reference is frozen: the command is to stand still
and the controller is not asked, so that no integral winds up and no predictor believes in motion
that was commanded and never flown. Commands go on, since only they can end the silence.

What telemetry tells about the delays: echoes become samples, samples become a horizon.

All ages are measured on cloud's own clock; world's stamps are only ever compared with each other,
so no clock synchronisation is needed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from math import isfinite, nan

from cloudrc.cloud.controllers import Controller, ControlOutput
from cloudrc.cloud.estimators import DelaySample, Estimator
from cloudrc.cloud.predictors import Predictor
from cloudrc.errors import in_words
from cloudrc.messages import NEVER_NS, ZERO, Command, Odometry, Setpoint, Telemetry, Vector
from cloudrc.records import Control, Fault

HORIZON_MAX = 1.0
"""Longest horizon of a prediction [s]. Source: docs/reference/control.md, "Predictors"."""


class DelayMeter:
    """Feeds a delay estimator and asks it how far to look ahead.

    Attributes:
        rtt: Last round trip, hold excluded [s]; NaN before the first.
        loop_delay: Last `now - echo_stamp`, hold included [s]; NaN likewise.
        newest_echo_ns: Stamp of the newest command that is seen to be flown [ns], cloud's clock.
    """

    def __init__(self, estimator: Estimator, counts: Counter[str]) -> None:
        """Ask `estimator`; what is clamped is counted in `counts`."""
        self._estimator, self._counts = estimator, counts
        self.newest_echo_ns = NEVER_NS
        self._stamp_ns = 0
        self.rtt = nan
        self.loop_delay = nan

    def observe(self, telemetry: Telemetry, now_ns: int) -> None:
        """Take in telemetry that became the newest, at its arrival.

        A repeated echo is no sample: while the downlink is silent the same command is echoed over
        and over, and its growing age would poison the estimate.
        """
        self._stamp_ns = telemetry.stamp_ns
        if telemetry.echo_stamp_ns <= self.newest_echo_ns:
            return
        self.newest_echo_ns = telemetry.echo_stamp_ns
        loop_ns = now_ns - telemetry.echo_stamp_ns
        applied_ns = telemetry.stamp_ns - telemetry.echo_hold_ns
        self.loop_delay = loop_ns * 1e-9
        self.rtt = (loop_ns - telemetry.echo_hold_ns) * 1e-9
        applied_minus_stamp = (applied_ns - telemetry.echo_stamp_ns) * 1e-9
        self._estimator.update(DelaySample(self.loop_delay, self.rtt, applied_minus_stamp))

    def horizon(self, now_ns: int) -> float:
        """How far to look ahead from the newest odometry for a command that leaves now.

        Args:
            now_ns: Cloud's clock [ns].

        Returns:
            Horizon [s], in [0, 1].

        Raises:
            ValueError: If the estimator gives something that is not finite.
        """
        horizon = float(self._estimator.horizon((now_ns - self._stamp_ns) * 1e-9))
        if 0.0 <= horizon <= HORIZON_MAX:
            return horizon
        if not isfinite(horizon):
            raise ValueError(f"its horizon is {horizon}")
        self._counts["horizon_clamped"] += 1
        return min(max(horizon, 0.0), HORIZON_MAX)


FREEZE_NS = 400_000_000
"""An echo that is silent for longer than the horizon and this freezes the reference [ns].
Source: docs/reference/plant.md, "Frozen reference"."""
STAND_STILL = ControlOutput(ZERO, 0.0)
_new = tuple.__new__  # of a named tuple: the constructor of its class takes twice the time


class ControlLoop:
    """Estimator, predictor and controller of one session."""

    def __init__(
        self,
        build_estimator: Callable[[], Estimator],
        predictor: Predictor,
        controller: Controller,
    ) -> None:
        """Join three plug-ins; the estimator is built anew for every session.

        Before anything flies a plug-in that fails may end this: whatever it raises gets out.
        """
        self._build_estimator = build_estimator
        self._predictor = predictor
        self._controller = controller
        self.faults: list[Fault] = []
        self.counts: Counter[str] = Counter()
        self._undated: list[Fault] = []
        estimator = build_estimator()
        predictor.reset()
        controller.reset()
        self._begin(estimator)

    def reset(self) -> None:
        """A new session begins: nothing measured in the old one counts."""
        try:
            estimator = self._build_estimator()
        except BaseException as error:
            self._note("estimator", error, NEVER_NS)
            estimator = Estimator()  # which knows nothing: the horizon stays 0
        self._reset("predictor", self._predictor.reset)
        self._reset("controller", self._controller.reset)
        self._begin(estimator)

    def _begin(self, estimator: Estimator) -> None:
        self._delays = DelayMeter(estimator, self.counts)
        self._basis: Odometry | None = None
        self._basis_arrival_ns = 0
        self._horizon = 0.0
        self._trusted_ns = NEVER_NS

    def start_mission(self) -> None:
        """A mission begins within the session: the controller starts anew."""
        self._reset("controller", self._controller.reset)
        self._trusted_ns = NEVER_NS

    def _reset(self, kind: str, reset: Callable[[], None]) -> None:
        try:
            reset()
        except BaseException as error:
            self._note(kind, error, NEVER_NS, "it is asked on as it is")

    @property
    def basis_stamp_ns(self) -> int:
        """When the newest odometry was measured [ns, world's clock]; `NEVER_NS` before any."""
        return NEVER_NS if self._basis is None else self._basis.stamp_ns

    @property
    def ready(self) -> bool:
        """Whether there is telemetry to compute a command from."""
        return self._basis is not None

    def observe(self, telemetry: Telemetry, now_ns: int) -> None:
        """Take in telemetry that became the newest, at its arrival [ns, cloud's clock]."""
        self._basis, self._basis_arrival_ns = telemetry.odometry, now_ns
        if self._undated:
            self.faults += [fault._replace(stamp_ns=now_ns) for fault in self._undated]
            self._undated.clear()
        try:
            self._delays.observe(telemetry, now_ns)
        except BaseException as error:
            self._note("estimator", error, now_ns)
        try:
            self._predictor.observe(telemetry.odometry)
        except BaseException as error:
            self._note("predictor", error, now_ns)

    def command(
        self, setpoint: Setpoint, now_ns: int, dt: float, epoch: int, counter: int
    ) -> tuple[Command, Control]:
        """Compute the command that is due now.

        Args:
            setpoint: Where to be.
            now_ns: Cloud's clock [ns].
            dt: Time since the last command [s], > 0.
            epoch: Of the session, for the record.
            counter: That the command will carry, for the record.
        """
        basis = self._basis
        assert basis is not None, "ask `ready` first"
        horizon = self._look_ahead(now_ns)
        estimate = self._predict(basis, horizon, now_ns)
        if self._is_unheard(now_ns, horizon):
            self.counts["frozen"] += 1
            output = STAND_STILL
        else:
            output = self._steer(estimate, setpoint, dt, now_ns)
        hold_ns = now_ns - self._basis_arrival_ns
        velocity, yaw_rate = output.velocity, output.yaw_rate
        command = _new(Command, (now_ns, basis.stamp_ns, hold_ns, velocity, yaw_rate))
        try:
            self._predictor.commanded(command)
        except BaseException as error:
            self._note("predictor", error, now_ns)
        known = (
            now_ns,
            epoch,
            counter,
            basis.stamp_ns,
            horizon,
            self._delays.rtt,
            self._delays.loop_delay,
            basis.position,
            estimate.position,
            estimate.orientation_wxyz,
            estimate.velocity,
            setpoint.position,
            setpoint.waypoint,
            velocity,
            yaw_rate,
            output.proportional,
            output.integral,
            output.derivative,
        )
        return command, _new(Control, known)

    def take_faults(self) -> list[Fault]:
        """Hand over what went wrong for the first time since the last call."""
        faults, self.faults = self.faults, []
        return faults

    def _look_ahead(self, now_ns: int) -> float:
        try:
            self._horizon = self._delays.horizon(now_ns)
        except BaseException as error:
            self._note("estimator", error, now_ns)
        return self._horizon

    # A sum is finite only if all its terms are. That it can overflow is no loss: numbers of that
    # size cannot be flown either.

    def _predict(self, basis: Odometry, horizon: float, now_ns: int) -> Odometry:
        try:
            estimate = self._predictor.predict(basis, horizon)
            position, velocity = _triple(estimate.position), _triple(estimate.velocity)
            w, x, y, z = estimate.orientation_wxyz
            orientation = (float(w), float(x), float(y), float(z))
            if not isfinite(sum(position) + sum(velocity) + sum(orientation)):
                raise ValueError(f"it returned {estimate}")
            stamp_ns, rate = estimate.stamp_ns, estimate.angular_velocity_body
            return _new(Odometry, (stamp_ns, position, orientation, velocity, rate))
        except BaseException as error:
            self._note("predictor", error, now_ns)
            return basis

    def _steer(
        self, estimate: Odometry, setpoint: Setpoint, dt: float, now_ns: int
    ) -> ControlOutput:
        try:
            output = self._controller.update(estimate, setpoint, dt)
            velocity, yaw_rate = _triple(output.velocity), float(output.yaw_rate)
            if not isfinite(sum(velocity) + yaw_rate):
                raise ValueError(f"it returned {output}")
            terms = _triple(output.proportional), _triple(output.integral)
            return _new(ControlOutput, (velocity, yaw_rate, *terms, _triple(output.derivative)))
        except BaseException as error:
            self._note("controller", error, now_ns)
            return STAND_STILL

    def _is_unheard(self, now_ns: int, horizon: float) -> bool:
        """Whether the echo has been silent for too long; before the first it has time, too."""
        if self._trusted_ns < self._delays.newest_echo_ns:
            self._trusted_ns = self._delays.newest_echo_ns
        elif self._trusted_ns == NEVER_NS:
            self._trusted_ns = now_ns
        return now_ns - self._trusted_ns > horizon * 1e9 + FREEZE_NS

    def _note(self, kind: str, error: BaseException, now_ns: int, instead: str = "") -> None:
        """Count what a plug-in did wrong; report it the first time.

        It is foreign code: anything may come out of it, but a person's Ctrl-C is not its own.
        What is noted at NEVER_NS is dated by the next telemetry.
        """
        if isinstance(error, KeyboardInterrupt):
            raise error
        code = f"{kind}_failed"
        self.counts[code] += 1
        if self.counts[code] == 1:
            fault = Fault(now_ns, code, _explain(kind, error, instead))
            (self._undated if now_ns == NEVER_NS else self.faults).append(fault)


_INSTEAD = {
    "estimator": "the last good horizon is used",
    "predictor": "the last sample is used unpredicted",
    "controller": "the command is zero velocity",
}


def _explain(kind: str, error: BaseException, instead: str) -> str:
    what = f"the {kind} failed ({in_words(error)}); {instead or _INSTEAD[kind]}"
    return f"{what}; mend cloud.{kind} or choose another"


def _triple(numbers: Vector) -> Vector:
    """Have it of numbers, whatever a plug-in has made of it; what is a triple stays as it is."""
    x, y, z = numbers
    return float(x), float(y), float(z)
