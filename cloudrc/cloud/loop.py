# SPDX-License-Identifier: Apache-2.0

"""Compute each command from the newest telemetry with estimator, predictor and controller.

If a plug-in raises an exception, or returns values that are not finite numbers, the loop uses a
safe value: the last good horizon, the last sample, or zero velocity. The loop counts every failure,
reports the first failure of each plug-in, in each mission again, and continues.

Telemetry echoes the stamp of the newest command that world has applied. It also contains the hold
time: from the application of the command to the sending of the telemetry. If no new echo arrives
for some time, the commands do not reach the robot, and the loop freezes: it commands zero velocity
and does not call the controller. So no integral winds up, and no predictor assumes a motion that
the robot did not fly. The loop works normally again after the echo of a new command.

The loop measures ages on cloud's clock, and subtracts stamps of world's clock only from each other.
It needs no clock synchronisation.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from copy import copy, deepcopy
from functools import lru_cache
from itertools import chain
from math import nan
from typing import TYPE_CHECKING, Any

from cloudrc.base.errors import ControllerLostError, describe_error
from cloudrc.base.outside.code import FAILURES, calling, check_failure, locate, stack_of
from cloudrc.base.outside.values import RESULT, InvalidValueError
from cloudrc.cloud.controllers import STAND_STILL, Controller, ControlOutput
from cloudrc.cloud.controllers.pid import Law, Pid
from cloudrc.cloud.estimators import DelaySample, Estimator
from cloudrc.cloud.motion import Body, pack_goal
from cloudrc.cloud.news import SendOnDelta
from cloudrc.cloud.plan_log import PlanLog
from cloudrc.cloud.predictors import Predictor
from cloudrc.cloud.results import (
    check_estimate,
    check_output,
    is_ours,
    to_rows,
    to_vector,
    to_vectors,
)
from cloudrc.teleop.carrot import path_of
from cloudrc.wire.messages import (
    FRESH_ECHO_PERIODS,
    NEVER_NS,
    PLAN_STEP_NS,
    Command,
    GuardState,
    Odometry,
    Setpoint,
    Telemetry,
    Vector,
    plan_length,
)
from cloudrc.wire.records import PLUG_IN_FAILED, UNSENT, Control, Fault, PlugInKind
from cloudrc.wire.tunnel.codec import as_planned

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

PERIOD_NS = 10_000_000
"""Time between two commands, unless an experiment sets another rate [ns].
Source: docs/reference/plant.md, "Commands"."""
ECHOES, ECHOES_NS = 32, 320_000_000
"""Smallest number of stored echoes, and the time for which echoes are stored [ns]. With the stored
echoes, the loop calls `add_applied` only once per command."""
UNUSED = Predictor.observe, Predictor.commanded, Predictor.applied
"""Methods of the base class, which need not be called."""
INSTEAD = {
    "estimator": "cloud uses the last good horizon",
    "predictor": "cloud uses the last sample without a prediction",
    "controller": "cloud commands zero velocity",
    "perception": "its last setpoint stays",
}
"""Kind of plug-in -> what cloud does when a plug-in of this kind fails."""
GOES_ON = "cloud goes on using it"
PLAN_STEP = PLAN_STEP_NS * 1e-9
"""Time between two velocities of a plan [s]."""
INSTANTS = 256
"""For how many instants the loop remembers the setpoint: more than two successive plans have."""
PLANNED_MAX = 1000.0
"""Largest component of a planned velocity [m/s]; the guard takes no plan with a larger one.
Source: docs/reference/faults.md, "F23"."""


_new = tuple.__new__  # makes a named tuple twice as fast as its class does


def _possible(velocities: NDArray[np.float64]) -> list[float]:
    """Return the numbers of the velocities before the first one that the guard takes in no plan.

    `velocities` have the shape (n, 3) [m/s].
    """
    numbers = velocities.ravel()
    too_large = abs(numbers) > PLANNED_MAX
    count = int(too_large.argmax()) // 3 * 3 if too_large.any() else len(numbers)
    found: list[float] = numbers[:count].tolist()
    return found


class ControlLoop:
    """Runs estimator, predictor and controller in the sessions of one cloud.

    Attributes:
        period_ns: Time between two commands [ns].
        ready: Whether telemetry has arrived in this session.
        faults: Faults since the last `take_faults`.
        lost: Why the flight has to end, if a controller outside is lost; else None.
        plans: The plans that the robot may still follow.
        counts: Name of an event, such as "frozen" -> how often it happened.
    """

    def __init__(
        self,
        build_estimator: Callable[[], Estimator],
        predictor: Predictor,
        controller: Controller,
        *,
        horizon_max: float,
        freeze_after: float,
        period_ns: int = PERIOD_NS,
        plan: float = 0.0,
        news: SendOnDelta | None = None,
    ) -> None:
        """Connect three plug-ins; every session gets a new estimator.

        `horizon_max` is the longest horizon [s]. The loop freezes if the newest echo is older than
        the horizon plus `freeze_after` [s]. `period_ns` is the time between two commands [ns]. Each
        command contains a plan, the velocities of the next `plan` [s]; 0 means no plan. Commands
        that are no `news` are withheld; None: all are sent.

        Here the failure of a plug-in ends the command, because the robot does not fly yet.
        """
        self._build_estimator, self._predictor = build_estimator, predictor
        self._controller = controller
        self._plans_itself: Any = getattr(controller, "plan", None)
        self._law: Law | None = None
        self._copy: Callable[[Controller], Controller] = deepcopy
        if type(controller) is Pid:  # not a user's class that derives from it
            self._law, self._copy = controller.law, copy  # its state is numbers alone
        self._trusts_predictor, self._trusts_controller = is_ours(predictor), is_ours(controller)
        methods = (getattr(predictor, name) for name in ("observe", "commanded", "applied"))
        self._observe, self._commanded, self._applied = (
            None if getattr(each, "__func__", None) in UNUSED else each for each in methods
        )
        self._horizon_max, self._freeze_after_ns = horizon_max, freeze_after * 1e9
        self.period_ns, self._hold_max_ns = period_ns, FRESH_ECHO_PERIODS * period_ns
        self._planned, self._news = plan_length(plan), news
        self.faults: list[Fault] = []
        self.lost: ControllerLostError | None = None
        self.counts: Counter[str] = Counter()
        self._now_ns = 0  # stamp of faults
        self._reported = set[str]()  # codes of faults that this mission has reported
        self._missions = 0
        estimator = build_estimator()
        for kind, plug_in in (("predictor", predictor), ("controller", controller)):
            what = f"cloud.{kind}: its reset() failed"
            slow = "" if is_ours(plug_in) else f"reset() of cloud.{kind} is still running"
            with calling(what, slow=slow):
                plug_in.reset()
        self._begin(estimator)

    def reset(self, now_ns: int) -> None:
        """Forget all measurements at the start of a session at `now_ns` [ns]."""
        self._now_ns = now_ns
        try:
            estimator = self._build_estimator()
        except FAILURES as error:
            self.note_failure("estimator", error)
            estimator = Estimator()  # it has no estimate, so the horizon stays 0
        self._call("predictor", self._predictor.reset)
        self._call("controller", self._controller.reset)
        self._begin(estimator)

    def _begin(self, estimator: Estimator) -> None:
        self._estimator = estimator
        self._echoes: deque[int] = deque(maxlen=max(ECHOES, ECHOES_NS // self.period_ns))
        self._newest_echo_ns = NEVER_NS  # stamp of the newest applied command [ns], cloud's clock
        self._expected = 0.0  # horizon while there is no echo and no estimate [s]
        # Newest round trip, without and with the hold time on world [s]; NaN before the first.
        self._rtt = self._loop_delay = nan
        self._basis: Odometry | None = None
        self.ready = False
        self._basis_arrival_ns = 0
        self._horizon, self._echoed_ns = 0.0, NEVER_NS
        self._guard, self._output = GuardState.GROUND, STAND_STILL
        self.plans = PlanLog()
        self._moving: Setpoint | None = None  # that of the next two functions of cloud's time [ns]
        self._later: Callable[[int], Setpoint]
        self._goal_at: Callable[[int], bytes]

    def start_mission(self) -> None:
        """Reset the controller at the start of a mission within the session.

        Failures before the first mission are reported already, in the recording of that mission.
        """
        self._missions += 1
        if self._missions > 1:
            self._reported.clear()
        self._call("controller", self._controller.reset)
        self._echoed_ns = NEVER_NS

    @property
    def basis_stamp_ns(self) -> int:
        """Stamp of the newest odometry [ns], world's clock; `NEVER_NS` before the first."""
        return NEVER_NS if self._basis is None else self._basis.stamp_ns

    @property
    def newest(self) -> tuple[int, Odometry | None, float, float]:
        """What a controller outside may know besides prediction and setpoint.

        Time of the newest telemetry or command [ns], cloud's clock, the newest odometry, the newest
        loop delay [s], NaN before the first, and the horizon [s].
        """
        return self._now_ns, self._basis, self._loop_delay, self._horizon

    def observe(self, telemetry: Telemetry, now_ns: int) -> None:
        """Process telemetry that arrived at `now_ns` [ns], cloud's clock."""
        self._basis, self._basis_arrival_ns = telemetry.odometry, now_ns
        self._now_ns, self.ready, self._guard = now_ns, True, telemetry.guard
        try:
            self._observe_delay(telemetry, now_ns)
        except FAILURES as error:
            self.note_failure("estimator", error, GOES_ON)
        if self._observe is not None:
            self._call("predictor", self._observe, telemetry.odometry)

    def expect(self, round_trip: float) -> None:
        """Use `round_trip` [s] as the horizon until telemetry echoes the first command."""
        self._expected = round_trip

    def observe_late(self, telemetry: Telemetry, now_ns: int) -> None:
        """Process telemetry that arrived after newer telemetry: use only its echo of a command."""
        self._now_ns = now_ns
        self._call("estimator", self._observe_echo, telemetry)

    def gives_sample(self, echo_stamp_ns: int, echo_hold_ns: int) -> bool:
        """Return whether telemetry that cloud uses gives the estimator a delay sample.

        `echo_stamp_ns` is the stamp of the command that it echoes [ns], `echo_hold_ns` the time
        since world applied this command [ns].

        Every telemetry datagram gives one sample of the paper's eq. (1), even if an earlier
        datagram had the same echo. A datagram whose hold time is above the limit gives none.
        Source: docs/reference/control.md, "The delay sample".
        """
        return echo_stamp_ns != NEVER_NS and echo_hold_ns <= self._hold_max_ns

    def _observe_delay(self, telemetry: Telemetry, now_ns: int) -> None:
        """Process the delays in telemetry that is newer than all earlier telemetry."""
        echo_ns, hold_ns = telemetry.echo_stamp_ns, telemetry.echo_hold_ns
        self._observe_echo(telemetry)
        if not self.gives_sample(echo_ns, hold_ns):
            return
        loop_ns = now_ns - echo_ns
        self._loop_delay, self._rtt = loop_ns * 1e-9, (loop_ns - hold_ns) * 1e-9
        self._estimator.update(_new(DelaySample, (self._loop_delay, self._rtt)))

    def _observe_echo(self, telemetry: Telemetry) -> None:
        """Process the echo of telemetry, which shows when a command was applied.

        World soon replaces a command with a long delay by the next command, so perhaps only one
        telemetry datagram echoes the delayed command. This datagram counts even if it arrives late:
        otherwise long delays would be missing in the average.
        """
        echo_ns = telemetry.echo_stamp_ns
        if echo_ns > self._newest_echo_ns:
            self._newest_echo_ns = echo_ns
        elif echo_ns == NEVER_NS or echo_ns in self._echoes:
            return
        self._echoes.append(echo_ns)
        applied_ns = telemetry.stamp_ns - telemetry.echo_hold_ns
        if self._applied is not None:
            self._call("predictor", self._applied, echo_ns, applied_ns)
        self._estimator.add_applied((applied_ns - echo_ns) * 1e-9)

    def _estimate_horizon(self, age: float) -> float:
        """Return the estimator's horizon, limited to its allowed range [s].

        `age` is cloud's time minus the stamp of the newest odometry on world's clock [s]. If the
        estimator fails, return the last horizon.
        """
        try:
            horizon = self._estimator.horizon(age)
            if type(horizon) is not float:
                horizon = RESULT.of(horizon, "horizon")
            if horizon == 0.0 and self._newest_echo_ns == NEVER_NS:
                horizon = self._expected
            if 0.0 <= horizon <= self._horizon_max:
                return horizon
            horizon = RESULT.of(horizon, "horizon")
        except FAILURES as error:
            self.note_failure("estimator", error)
            return self._horizon
        self.counts["horizon_clamped"] += 1
        return float(min(max(horizon, 0.0), self._horizon_max))

    def command(
        self, setpoint: Setpoint, now_ns: int, dt: float, epoch: int, counter: int
    ) -> tuple[Command | None, Control]:
        """Compute the command that is due at `now_ns` [ns], None if it is withheld, and its record.

        Args:
            setpoint: The newest setpoint.
            now_ns: Cloud's clock [ns].
            dt: Time since the last command [s], > 0.
            epoch: Number of the session, for the record.
            counter: Counter of the command's datagram, for the record.
        """
        basis, self._now_ns = self._basis, now_ns
        setpoint = self._look_ahead(setpoint, now_ns)
        assert basis is not None, "check `ready` first"
        self._horizon = horizon = self._estimate_horizon((now_ns - basis.stamp_ns) * 1e-9)
        estimate = self._predict(basis, horizon)
        plan: list[Vector] = []  # `list[Vector]()` takes six times as long
        positions: list[Vector] = []
        output: ControlOutput | None = STAND_STILL
        self._echoed_ns = max(self._echoed_ns, self._newest_echo_ns)
        if self._echoed_ns == NEVER_NS:
            self._echoed_ns = now_ns
        if now_ns - self._echoed_ns > horizon * 1e9 + self._freeze_after_ns:  # no new echo
            self.counts["frozen"] += 1
            if self._plans_itself:  # its last plan is no longer what the robot follows
                self._call("controller", self._controller.reset)
        elif self._plans_itself and (planned := self._ask_plan(now_ns, dt)):
            output, plan, positions = planned
        else:
            output = self._steer(estimate, setpoint, dt)
            if self._planned and output is not None:
                plan, positions = self._plan(output.velocity, now_ns)
        says_nothing, output = output is None, output or self._output
        held_ns = now_ns - self._basis_arrival_ns
        planned_ns = basis.stamp_ns + round(horizon * 1e9) if plan else NEVER_NS
        fields = (now_ns, basis.stamp_ns, held_ns, *output[:2], tuple(plan), planned_ns)
        command = _new(Command, fields)
        if plan:
            self.plans.add(command, [estimate.position, *positions])
        if says_nothing or (self._news is not None and not self._news.has(command, self._guard)):
            self.counts["commands_withheld"] += 1
            counter = UNSENT
        elif self._commanded is not None:
            self._call("predictor", self._commanded, command)
        control = _new(Control, (
            now_ns, epoch, counter, basis.stamp_ns, horizon, self._rtt, self._loop_delay,
            basis.position, *estimate[1:4], setpoint.position, setpoint.waypoint, *output,
        ))  # fmt: skip
        return None if counter == UNSENT else command, control

    def take_faults(self) -> list[Fault]:
        """Return the faults that happened since the last call."""
        faults, self.faults = self.faults, []
        return faults

    def _predict(self, basis: Odometry, horizon: float) -> Odometry:
        try:
            estimate = self._predictor.predict(basis, horizon)
            return estimate if self._trusts_predictor else check_estimate(estimate)
        except FAILURES as error:
            self.note_failure("predictor", error)
            return basis

    def _steer(self, estimate: Odometry, setpoint: Setpoint, dt: float) -> ControlOutput | None:
        if self.lost is not None:
            return STAND_STILL
        try:
            output = self._controller.update(estimate, setpoint, dt)
            if output is None:
                self._echoed_ns = self._now_ns  # without a command, there is no echo to wait for
                return None
            self._output = output if self._trusts_controller else check_output(output)
            return self._output
        except ControllerLostError as error:  # the flight ends when its driver sees the fault
            self.lost = error
            self.faults.append(Fault(self._now_ns, error.code, str(error)))
            return STAND_STILL
        except FAILURES as error:
            self.note_failure("controller", error)
            return STAND_STILL

    def _ask_plan(
        self, now_ns: int, dt: float
    ) -> tuple[ControlOutput | None, list[Vector], list[Vector]] | None:
        """Let a controller plan by itself; return its command, and the results of `_plan`.

        Return None if the predictor has no model. If the controller plans nothing, the command is
        None. `now_ns` is the time of the command [ns], cloud's clock, `dt` that since the last [s].
        """
        later = self._later
        plug_in: PlugInKind = "predictor"
        try:
            model = self._predictor.model()
            if model is None:
                return None
            plug_in = "controller"
            made = self._plans_itself(model, lambda ahead: later(now_ns + round(ahead * 1e9)), dt)
            if made is None:
                self._echoed_ns = now_ns  # without a command, there is no echo to wait for
                return None, [], []
            velocities, positions, yaw_rate = made
            rows = to_rows(velocities[: self._planned + 1], "planned velocities")
            x, y, z = rows[0].tolist()
            self._output = output = ControlOutput((x, y, z), RESULT.of(yaw_rate, "yaw rate"))
            positions = to_vectors(positions[: self._planned], "planned positions")
            return output, as_planned(_possible(rows[1:])), positions
        except FAILURES as error:
            self.note_failure(plug_in, error, INSTEAD["controller"])
            return STAND_STILL, [], []

    def _plan(self, velocity: Vector, now_ns: int) -> tuple[list[Vector], list[Vector]]:
        """Plan the velocities [m/s] that follow a command, by simulating the flight.

        Args:
            velocity: Velocity of the command [m/s].
            now_ns: Time of the command [ns], cloud's clock.

        Returns:
            One velocity [m/s] per PLAN_STEP after the command, and the position [m] for which it
            was computed. The plan ends before the first velocity that the guard rejects. It is
            empty if the predictor has no model, or if a plug-in fails.
        """
        plan, positions, most = list[Vector](), list[Vector](), PLANNED_MAX
        plug_in: PlugInKind = "predictor"
        try:
            model = self._predictor.model()
            if model is None:
                return plan, positions
            begin_ns = now_ns + PLAN_STEP_NS
            times_ns = range(begin_ns, begin_ns + self._planned * PLAN_STEP_NS, PLAN_STEP_NS)
            if self._law and isinstance(model, Body) and self._trusts_predictor:
                goals = [*map(self._goal_at, times_ns)]
                if flown := model.follow(self._law, goals, PLAN_STEP, velocity, most):
                    return flown
            plug_in = "controller"
            controller = self._copy(self._controller)
            for goal in map(self._later, times_ns):
                plug_in = "predictor"
                state = model.step(velocity, PLAN_STEP)
                if not self._trusts_predictor:
                    state = check_estimate(state)
                plug_in = "controller"
                output = controller.update(state, goal, PLAN_STEP)
                if output is not None:
                    velocity = output.velocity
                if not self._trusts_controller:
                    velocity = to_vector(velocity, "planned velocity")
                x, y, z = velocity
                if not (abs(x) <= most and abs(y) <= most and abs(z) <= most):
                    RESULT.row(velocity, 3, "planned velocity")
                    break
                plan.append(velocity)
                positions.append(state.position)
        except FAILURES as error:
            self.note_failure(plug_in, error, "cloud sends this command without a plan")
            return [], []
        return as_planned([*chain.from_iterable(plan)]), positions

    def _look_ahead(self, setpoint: Setpoint, now_ns: int) -> Setpoint:
        """Set `_later` and `_goal_at` of a setpoint that may move; return it at `now_ns` [ns].

        They remember their results: the plans of two commands have most instants in common.
        """
        if setpoint is not self._moving:
            later, remember = path_of(setpoint), lru_cache(maxsize=INSTANTS)
            self._moving, self._later = setpoint, remember(later)
            self._goal_at = remember(lambda now_ns: pack_goal(later(now_ns)))
        return setpoint if setpoint.motion is None else self._later(now_ns)

    def _call(self, kind: PlugInKind, call: Callable[..., None], *arguments: Any) -> None:
        """Call a plug-in's method that has no result; count and report an exception."""
        try:
            call(*arguments)
        except FAILURES as error:
            self.note_failure(kind, error, GOES_ON)

    def note_failure(self, kind: PlugInKind, error: BaseException, instead: str = "") -> None:
        """Count a failure of the plug-in `kind`, such as "estimator"; report a mission's first one.

        `instead` tells the user what cloud does now; "" stands for the text in `INSTEAD`.

        Raises:
            BaseException: `error`, if it is not the plug-in's failure.
        """
        check_failure(error, f"cloud.{kind}")
        code = PLUG_IN_FAILED[kind]
        self.counts[code] += 1
        if code not in self._reported:
            self._reported.add(code)
            where = "" if isinstance(error, InvalidValueError) else f", {locate(error)}"
            what = f"the {kind} failed ({describe_error(error)}{where})"
            text = f"{what}; {instead or INSTEAD[kind]}; fix cloud.{kind} or choose another"
            self.faults.append(Fault(self._now_ns, code, text, stack_of(error)))
