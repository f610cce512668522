# SPDX-License-Identifier: Apache-2.0

"""Build cloud: its plug-ins, and cloud's end of the tunnel."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from cloudrc.base.errors import ControllerLostError
from cloudrc.cloud.compute_time import ComputeTime, compute_time
from cloudrc.cloud.controllers import Controller
from cloudrc.cloud.controllers.remote import ControllerTransport, OutsideController
from cloudrc.cloud.endpoint import CloudEndpoint
from cloudrc.cloud.loop import ControlLoop
from cloudrc.cloud.news import SendOnDelta
from cloudrc.cloud.operator import Operator
from cloudrc.cloud.perceiving import Here, Perceiver
from cloudrc.cloud.planar import Planar
from cloudrc.config.overrides import build_plugin
from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.flight.assembly.draws import SECOND_NS, generator
from cloudrc.flight.assembly.sensing import (
    build_receiver,
)
from cloudrc.physics.geometry.rays import angles_of
from cloudrc.wire.endpoint import Worker
from cloudrc.wire.records import CONTROLLER_LOST, Fault
from cloudrc.wire.tunnel.end import Identity

if TYPE_CHECKING:
    from cloudrc.wire.records import Record


def lost_controller(records: Iterable[Record]) -> Iterator[ControllerLostError]:
    """Yield the faults in cloud's records with which a flight ends, as errors."""
    for record in records:
        if isinstance(record, Fault) and record.code in CONTROLLER_LOST:
            yield ControllerLostError(record.code, record.text)


def build_cloud(
    experiment: ResolvedExperiment,
    identity: Identity,
    teleop: Operator,
    clock: Callable[[], int] = lambda: 0,
    *,
    cpu_clock: Callable[[], int] | None = None,
    make_loop: Callable[..., ControlLoop] = ControlLoop,
    transport: ControllerTransport | None = None,
    compute: ComputeTime | None = None,
    make_worker: Callable[[ComputeTime | None], Worker] = Here,
) -> CloudEndpoint:
    """Build cloud: plug-ins, and cloud's end of the tunnel.

    `teleop` provides the setpoints. `clock` returns cloud's monotonic time [ns]. In virtual time,
    `cpu_clock` returns the processor time of this thread [ns], which delays commands if
    `cloud.compute_measured` is set. `make_loop` is called in place of `ControlLoop`, for example to
    make a loop that lies. `transport` leads to a program outside that controls the robot. `compute`
    takes the place of the time that the experiment says. `make_worker` makes what calls the
    perception, whose emulated time it gets.
    """
    cloud = experiment.cloud
    controller = build_controller(experiment)
    remote = controller if isinstance(controller, OutsideController) else None
    if experiment.robot.planar:
        controller = Planar(controller, cloud.controller.name)
    loop = _build_loop(experiment, controller, make_loop)
    if remote is not None and transport is not None:
        remote.connect(transport, loop.period_ns * 1e-9, loop.counts, lambda: loop.newest)
    measured = cpu_clock if cloud.compute_measured else None
    if compute is None:
        compute = build_compute_time(experiment, measured)
    return CloudEndpoint(
        loop,
        teleop,
        identity,
        newest_wins=experiment.tunnel.order == "newest",
        compute=compute,
        perceiver=_build_perceiver(experiment, loop, make_worker, measured),
        frames=build_receiver(experiment),
        start_ns=clock(),
        on_arrival=cloud.answers == "arrival",
    )


def _build_loop(
    experiment: ResolvedExperiment, controller: Controller, make_loop: Callable[..., ControlLoop]
) -> ControlLoop:
    cloud = experiment.cloud
    beat, delta = cloud.beat, cloud.send_delta_mps
    news = None if delta is None else SendOnDelta(delta, beat)
    return make_loop(
        lambda: build_plugin("estimators", cloud.estimator),
        build_plugin("predictors", cloud.predictor, robot=experiment.robot_facts),
        controller,
        horizon_max=cloud.horizon_max_s,
        freeze_after=cloud.freeze_after_s + (beat if news else 0.0),
        period_ns=round(SECOND_NS / cloud.command_rate_hz),
        plan=cloud.plan_s,
        news=news,
    )


def _build_perceiver(
    experiment: ResolvedExperiment,
    loop: ControlLoop,
    make_worker: Callable[[ComputeTime | None], Worker],
    cpu_clock: Callable[[], int] | None,
) -> Perceiver | None:
    """Build what steers by what the robot sees; None without a perception."""
    cloud, scan = experiment.cloud, experiment.robot.scan
    if cloud.perception is None:
        return None
    perception = build_plugin("perceptions", cloud.perception, robot=experiment.robot_facts)
    draws = generator(experiment.seed, "perception time", experiment.stream)
    worker = make_worker(compute_time(cloud, cloud.perception_ms, draws, cpu_clock))
    angles = angles_of(scan.rays, scan.fov_deg) if scan else np.empty(0)
    fence = experiment.world.files.fence
    return Perceiver(perception, worker, fence, angles, partial(loop.note_failure, "perception"))


def build_compute_time(
    experiment: ResolvedExperiment, cpu_clock: Callable[[], int] | None = None
) -> ComputeTime | None:
    """Build the time that cloud needs for a command, plus that of `cpu_clock`; None: no time."""
    cloud = experiment.cloud
    return compute_time(
        cloud,
        cloud.compute_ms,
        generator(experiment.seed, "compute time", experiment.stream),
        cpu_clock,
        deviation_ms=cloud.compute_deviation_ms,
        cpu_share=cloud.cpu_share,
    )


def build_controller(experiment: ResolvedExperiment) -> Controller:
    """Build the controller of an experiment."""
    choice = experiment.cloud.controller
    controller: Controller = build_plugin("controllers", choice, robot=experiment.robot_facts)
    return controller
