# SPDX-License-Identifier: Apache-2.0

"""The section `cloud` of an experiment: the remote controller and the computer that it runs on."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from cloudrc.config.choice import PlugInChoice
from cloudrc.config.profile import CloudTime, ComputeMs
from cloudrc.config.section import Section, leave_out_unset
from cloudrc.link.profile import Positive

Count = Annotated[int, Field(ge=1)]
PlanTime = Annotated[float, Field(ge=0, le=0.8)]
COMMAND_RATE_MIN_HZ, COMMAND_RATE_MAX_HZ = 20, 500
"""Smallest and largest value of cloud.command_rate_hz [Hz]; the guard runs at 500 Hz."""
Sharing = Literal["fifo", "ps"]
ComputeSpeed = Annotated[float, Field(ge=0.01, le=100)]
"""Speed of a processor, as a multiple of that of the reference."""


class Cloud(Section):
    """The remote controller."""

    estimator: PlugInChoice = "running_mean"
    """Estimates the delays: a name, or a mapping with parameters"""
    predictor: PlugInChoice = "constant_velocity"
    """Predicts the odometry at the time at which a command takes effect: a name, or a mapping with
    parameters"""
    controller: PlugInChoice = "pid"
    """Tracks the setpoint: a name, or a mapping with parameters"""
    perception: PlugInChoice | None = None
    """Makes setpoints of what the robot's scanner or camera sees, while a mission flies: a name, or
    a mapping with parameters. Teleop's waypoints then say only when the mission is over. null:
    none"""
    perception_ms: ComputeMs = 0.0
    """Emulated computing time of perception for one scan or picture [ms], as compute_ms. It has a
    core of its own: commands do not wait for it, and what arrives meanwhile replaces each other"""
    plan_s: PlanTime = 0.0
    """Length of the plan in each command [s], with velocities in steps of 10 ms. The robot
    follows the plan while newer commands are late or lost. A plan needs a predictor with a model;
    use it with the estimator earliest. 0: no plan"""
    send_delta_mps: Positive | None = None
    """Send-on-delta: cloud sends a command only if its plan differs from that of the last one sent,
    by more than this velocity on an axis [m/s] or more than this number in the yaw rate [rad/s];
    and after beat_s. Needs plan_s above 0. While the guard is in HOLD, every command is sent. null:
    always"""
    beat_s: CloudTime | None = None
    """With send_delta_mps, the longest time between two commands [s]. null: a quarter of plan_s"""
    horizon_max_s: CloudTime | None = None
    """Longest horizon of the prediction [s]. null: the link profile's value, else 1"""
    freeze_after_s: CloudTime | None = None
    """Cloud commands zero velocity if telemetry has confirmed no new command for this time plus the
    prediction horizon [s]. null: the link profile's value, else 0.4"""
    command_rate_hz: Annotated[int, Field(ge=COMMAND_RATE_MIN_HZ, le=COMMAND_RATE_MAX_HZ)] = 100
    """Rate of the commands [Hz]. At less than 20 Hz the guard would never leave HOLD, which takes
    10 commands within 500 ms"""
    answers: Literal["period", "arrival"] = "period"
    """When cloud computes a command. period: at command_rate_hz; arrival: as newer telemetry
    arrives, at most once in half a period, and after 1.5 periods without any. Then no telemetry
    waits for a period, but the downlink has more packets if both rates differ"""
    compute_ms: ComputeMs = 0.0
    """Mean of the emulated computing time of a command [ms]; or a CSV file with the column
    compute_ms or compute_s, of which each command takes a random row: `cloudrc measure compute`
    writes it. In real time, the true computing time is added. Cloud begins the next command only
    after this time. It is a part of downlink_delay_mean and rtt_mean; the budget has it apart"""
    compute_deviation_ms: Annotated[float, Field(ge=0, le=1000)] = 0.0
    """Standard deviation of the time compute_ms [ms], which then has a gamma distribution; needs
    compute_ms above 0"""
    compute_measured: bool = False
    """Whether virtual time delays each command also by the processor time that this machine needed
    to compute it. Such a flight is not repeatable"""
    cpu_share: Annotated[float, Field(gt=0, le=1)] = 1.0
    """CPU limit of the emulated cloud, in processors: of each 100 ms it computes for this share,
    and then stands still, as a container with a limit does. It applies to the times of compute_ms
    and compute_measured. For a slow processor, lower speed instead. 1: no limit"""
    clock_offset_s: Annotated[float, Field(ge=0, le=1_000_000)] = 0.0
    """By how much cloud's clock is ahead of world's at the start [s]; virtual time only"""
    clock_drift_ppm: Annotated[int, Field(ge=-1000, le=1000)] = 0
    """By how much cloud's clock is faster than world's [ppm]; virtual time only"""
    place: str | None = None
    """Where cloud runs: name of a shipped place, or a path. It gives the link, speed, cores and
    sharing. A key of these that the experiment or a setting gives wins over the place, but the
    place replaces the experiment's link.profile. null: link and keys as given"""
    speed: ComputeSpeed = 1.0
    """Speed of cloud's processor: with 0.2, each computation needs 5 times compute_ms, which holds
    for the reference, speed 1"""
    cores: Count | None = None
    """Number of cores that the clouds of a fleet share, each for compute_ms; virtual time only.
    null: each robot's cloud has a core of its own"""
    sharing: Sharing = "fifo"
    """How the clouds share cores. fifo: one computation after the other; ps: processor sharing, all
    at the same time, each more slowly"""

    _write = leave_out_unset("answers", "perception", "perception_ms")

    @model_validator(mode="after")
    def _check_compute(self) -> Cloud:
        timed = self.compute_ms or self.place is not None
        if self.cores and (not timed or self.compute_measured or self.cpu_share < 1):
            raise ValueError("cores needs compute_ms above 0, not compute_measured or cpu_share")
        mean = self.compute_ms if isinstance(self.compute_ms, float) else 0.0
        if self.compute_deviation_ms > 0 and not mean:
            raise ValueError("compute_deviation_ms needs compute_ms, the mean, above 0")
        if self.perception is None and self.perception_ms:
            raise ValueError("perception_ms needs perception")
        if self.cpu_share < 1 and not (self.compute_ms or self.compute_measured):
            raise ValueError("cpu_share needs compute_ms above 0 or compute_measured")
        if self.send_delta_mps is not None and not self.plan_s:
            raise ValueError("send_delta_mps needs plan_s above 0: the robot follows the plan")
        return self

    @property
    def beat(self) -> float:
        """Longest time between two commands with `send_delta_mps` [s]."""
        return self.plan_s / 4 if self.beat_s is None else self.beat_s
