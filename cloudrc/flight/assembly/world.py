# SPDX-License-Identifier: Apache-2.0

"""Build world: the robot in its scene, and world's end of the tunnel."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.flight.assembly.draws import SECOND_NS, generator
from cloudrc.flight.assembly.sensing import (
    build_frame_source,
    build_scanner,
    build_target,
)
from cloudrc.wire.endpoint import Worker
from cloudrc.wire.tunnel.end import Identity

if TYPE_CHECKING:
    from cloudrc.world.endpoint import WorldEndpoint


def step_code(experiment: ResolvedExperiment) -> str:
    """Say what runs the usual physics steps: "C" with a hash of the machine code, or "Python"."""
    from cloudrc.robots.build import accelerator

    faster = accelerator(experiment.world)
    return f"C {faster.code}" if faster and faster.make else "Python"


def build_world(
    experiment: ResolvedExperiment,
    identity: Identity,
    clock: Callable[[], int] = lambda: 0,
    make_worker: Callable[[], Worker] | None = None,
) -> WorldEndpoint:
    """Build world: the robot in its scene, and world's end of the tunnel. Needs MuJoCo.

    `clock` returns the monotonic time [ns]. It is called last, at the start of world's time, so
    that the duration of compiling the scene does not count. `make_worker` makes what renders
    pictures beside world; None: they take no time.
    """
    from cloudrc.physics.sim.plant import Wind
    from cloudrc.robots.build import build_robot
    from cloudrc.world.endpoint import WorldEndpoint
    from cloudrc.world.sensors import Sensors

    world, seed = experiment.world, experiment.seed
    noise, turn_noise, air = (
        generator(seed, name, experiment.stream)
        for name in ("odometry noise", "attitude noise", "wind")
    )
    wind = Wind(world.wind, air) if world.wind.blows else None
    robot = build_robot(world, experiment.guard, wind)
    return WorldEndpoint(
        robot,
        Sensors(world.sensors, noise, turn_noise),
        identity,
        newest_wins=experiment.tunnel.order == "newest",
        odometry_period_ns=SECOND_NS // world.odometry_rate_hz,
        start_ns=clock(),
        scanner=build_scanner(experiment, robot, generator(seed, "scan noise", experiment.stream)),
        frame_source=build_frame_source(experiment, robot, make_worker),
        target=build_target(experiment, robot),
    )
