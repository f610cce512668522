# SPDX-License-Identifier: Apache-2.0

"""The testbed's own robots as environments: a policy flies them in place of the cloud's controller.

World, guard, tunnel and missions are those of every flight in virtual time. So the true path is,
bit by bit, that of a flight whose controller sends the same commands.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping
from math import dist
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium import spaces

from cloudrc.base.outside.refusal import naming
from cloudrc.base.outside.values import RESULT
from cloudrc.base.requirements import SIM, require
from cloudrc.cloud.controllers import Controller, ControlOutput
from cloudrc.cloud.loop import ControlLoop
from cloudrc.config.problems import problem_at
from cloudrc.config.schema import Link
from cloudrc.flight.assembly.link import build_links
from cloudrc.flight.assembly.plan import flight_limit
from cloudrc.flight.experiment import load
from cloudrc.flight.virtual.flight import assemble
from cloudrc.flight.virtual.run import VirtualRun
from cloudrc.results.record.columns import Recording, RecordStore
from cloudrc.results.report.document import Run
from cloudrc.results.report.write import assess
from cloudrc.wire.messages import Datagram, Odometry, Setpoint

if TYPE_CHECKING:
    from cloudrc.config.resolved import ResolvedExperiment
    from cloudrc.wire.endpoint import Endpoint

NEVER_NS = 1 << 62
"""Time of the cloud's next period while it waits for the policy [ns]."""
SEED_MAX = 2**31
"""Random seeds of episodes are below this number."""
SPACE, PLANE = ("vx", "vy", "vz"), ("vx", "vy")
"""Velocities in an action for a robot that flies, and for one that stays on the ground."""
OWN = {
    "link.profile": "ideal",
    "cloud.clock_drift_ppm": 0,
    "cloud.clock_offset_s": 0,
    "cloud.compute_deviation_ms": 0,
    "cloud.compute_measured": False,
    "cloud.cpu_share": 1,
    "cloud.place": None,
    "cloud.speed": 1,
    "cloud.send_delta_mps": None,
    "cloud.predictor": "last_sample",
    "cloud.estimator": "running_mean",
    "cloud.controller": "pid",
    "cloud.plan_s": 0,
    "cloud.compute_ms": 0,
}
"""Settings of every environment: the network and the controller are the policy's affair."""


class _Policy(Controller):
    """Controller that commands what the policy has decided."""

    def __init__(self) -> None:
        self.output: ControlOutput | None = ControlOutput((0.0, 0.0, 0.0), 0.0)
        self.setpoint: Setpoint | None = None  # that of the last command

    def update(self, estimate: Odometry, setpoint: Setpoint, dt: float) -> ControlOutput | None:
        self.setpoint = setpoint
        return self.output


class _Waiting:
    """A cloud that handles one of its periods per step, and then waits for the policy."""

    def __init__(self, cloud: Endpoint) -> None:
        self._cloud, self.may = cloud, False
        self.receive_datagram = cloud.receive_datagram
        self.take_records = cloud.take_records

    def next_deadline_ns(self) -> int:
        return self._cloud.next_deadline_ns() if self.may else NEVER_NS

    def handle_deadline(self, now_ns: int) -> None:
        self.may = False
        self._cloud.handle_deadline(now_ns)

    def take_datagrams(self) -> list[Datagram]:
        return self._cloud.take_datagrams()


class _Flight:
    """One flight, period by period of the cloud."""

    def __init__(self, experiment: ResolvedExperiment) -> None:
        self.experiment = experiment
        self.policy, self.store = _Policy(), RecordStore()

        def make_loop(estimator: Any, predictor: Any, controller: Any, **keys: Any) -> ControlLoop:
            return ControlLoop(estimator, predictor, self.policy, **keys)

        world, self.cloud, self.teleop, _ = assemble(experiment, make_loop)
        self._waiting = _Waiting(self.cloud)
        self._run = VirtualRun(world, self._waiting, *build_links(experiment))
        self._period_ns = round(1e9 / experiment.cloud.command_rate_hz)
        self._fly(self.cloud.next_deadline_ns())

    @property
    def now_ns(self) -> int:
        """Time since the start [ns]."""
        return self._run.now_ns

    def step(self) -> None:
        """Handle the cloud's period, and everything before its next one."""
        self._waiting.may = True
        self._fly(self._run.now_ns + self._period_ns)

    def _fly(self, until_ns: int) -> None:
        self._run.fly(lambda: False, until_ns, self.store.add)


class RobotEnv(gymnasium.Env[Any, Any]):
    """A robot of the testbed with its guard and a mission; a step is one command, 10 ms.

    An action is the velocity in x, y and z [m/s], world frame, and the yaw rate [rad/s]; a robot on
    the ground has no z. An observation is the newest odometry and the setpoint: position [m],
    orientation as a quaternion wxyz, velocity [m/s], angular velocity in the body frame [rad/s],
    position of the setpoint [m] and its yaw [rad]. The reward of a step is minus the distance from
    the setpoint [m].

    An episode ends with its mission. Then `info` has the `verdict` of the flight, its `failures`,
    `is_success` and the `numbers` of the report. `reset(seed=...)` is the seed of the experiment.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012

    def __init__(
        self,
        experiment: str = "steps",
        robot: str | None = None,
        settings: Mapping[str, Any] | None = None,
        render_mode: str | None = None,
    ) -> None:
        """Load an experiment by name or path.

        Args:
            experiment: Name of a shipped experiment, or path of a file.
            robot: Name of a shipped robot, or path; None: that of the experiment.
            settings: Further changes, as with `--set`: key -> value. The link is always ideal,
                and nothing fails.
            render_mode: None; a flight is drawn by its report.
        """
        require("a robot of the testbed as an environment", SIM)
        for key in settings or {}:
            if key in OWN or key.startswith(("link", "faults")):
                raise problem_at(key, "is the affair of Networked and the policy; leave it out")
        texts = {**(settings or {}), **OWN, **({"world.robot": robot} if robot else {})}
        self.render_mode = render_mode
        loaded = load(
            experiment, [f"{key}={json.dumps(value, default=str)}" for key, value in texts.items()]
        )
        self.experiment = loaded.model_copy(update={"link": Link(profile="ideal"), "faults": ()})
        guard = self.experiment.guard
        axes = PLANE if self.experiment.robot.planar else SPACE
        self._parts = (*axes, "yaw rate")
        most = np.array([guard.speed_max_mps] * len(axes) + [guard.yaw_rate_max_radps])
        self.action_space = spaces.Box(-most, most, dtype=np.float64)
        self.observation_space = spaces.Box(-np.inf, np.inf, (17,), dtype=np.float64)
        self.dt = 1.0 / self.experiment.cloud.command_rate_hz
        self._limit_ns = flight_limit(self.experiment) * 1e9
        self.flight: _Flight | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin a flight; return when the cloud is about to send its first command."""
        super().reset(seed=seed)
        own = int(self.np_random.integers(SEED_MAX)) if seed is None else seed
        experiment = self.experiment.model_copy(update={"seed": own})
        first, periods = _Flight(experiment), 0
        while first.policy.setpoint is None:
            first.step()
            periods += 1
        self.flight = _Flight(experiment)
        for _ in range(periods - 1):
            self.flight.step()
        self.flight.policy.setpoint = first.policy.setpoint
        return self._observe(self.flight)[0], {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Command a velocity and a yaw rate for one period of the cloud; None: send nothing."""
        flight = self.flight
        if flight is None:
            raise gymnasium.error.ResetNeeded("call reset() before step()")
        flight.policy.output = None if action is None else self._output_of(action)
        flight.step()
        observation, distance = self._observe(flight)
        ended = flight.teleop.over
        late = not ended and flight.now_ns >= self._limit_ns
        info = self._judge(flight) if ended or late else {}
        return observation, -distance, ended, late, info

    def _output_of(self, action: Any) -> ControlOutput:
        with naming("action", ", ".join(self._parts)):
            x, y, *climb, yaw_rate = RESULT.row(action, len(self._parts))
        return ControlOutput((x, y, climb[0] if climb else 0.0), yaw_rate)

    def _observe(self, flight: _Flight) -> tuple[Any, float]:
        """Return the observation, and the distance from the setpoint [m]."""
        telemetry, setpoint = flight.cloud.telemetry, flight.policy.setpoint
        assert telemetry is not None, "a command follows telemetry"
        assert setpoint is not None, "reset() waits for the first setpoint"
        _, position, orientation, velocity, turn = telemetry.odometry
        parts = (*position, *orientation, *velocity, *turn, *setpoint.position, setpoint.yaw)
        return np.array(parts), dist(position, setpoint.position)

    def _judge(self, flight: _Flight) -> dict[str, Any]:
        """Judge the flight as its report does."""
        recording, run = Recording(records=flight.store), Run("virtual", "virtual")
        own = flight.experiment.report.metrics
        found = assess(recording, flight.experiment, run, own)
        for note in found.metric_notes:
            warnings.warn(note, stacklevel=3)
        return {
            "verdict": found.verdict.outcome,
            "failures": [failure.code for failure in found.verdict.failures],
            "is_success": found.verdict.outcome == "success",
            "numbers": {name: number.value for name, number in found.numbers.items()},
        }
