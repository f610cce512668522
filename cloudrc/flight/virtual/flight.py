# SPDX-License-Identifier: Apache-2.0

"""Build world, cloud, teleop and the link for a flight in virtual time, and fly it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, closing, nullcontext
from itertools import count
from typing import TYPE_CHECKING

from cloudrc.base.errors import ControllerLostError
from cloudrc.base.outside.code import apart
from cloudrc.cloud.compute_time import ComputeTime
from cloudrc.cloud.controllers.remote import ControllerTransport, OutsideController
from cloudrc.cloud.endpoint import CloudEndpoint
from cloudrc.cloud.loop import ControlLoop
from cloudrc.config.faults import CLOUD_KILLED, CLOUD_PAUSED, WORLD_PAUSED, acting
from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.flight.assembly.cloud import build_cloud, build_controller, lost_controller
from cloudrc.flight.assembly.link import build_links, phase_ns
from cloudrc.flight.assembly.plan import build_plan, flight_limit
from cloudrc.flight.assembly.world import build_world
from cloudrc.flight.pod.transports import find_transport
from cloudrc.link.model import LinkDirection
from cloudrc.link.queue import PacketQueue
from cloudrc.teleop.mission import Teleop
from cloudrc.wire.records import Fault
from cloudrc.wire.tunnel.end import Identity
from cloudrc.wire.tunnel.keys import Key, KeyRing, KeySet

if TYPE_CHECKING:
    from cloudrc.flight.virtual.run import Clock, Sink, VirtualRun
    from cloudrc.wire.records import Record
    from cloudrc.world.endpoint import WorldEndpoint

CLOUD_CLOCK = b"cloud".ljust(16)
"""Identity of cloud's clock in virtual time, if it differs from world's clock."""
MEASURED = "Not repeatable: cloud.compute_measured uses the processor time of this machine."
ONLY_MISSION = 1
"""Mission number in virtual time, where teleop flies only one mission."""
VIRTUAL_CLOCK = bytes(16)
"""Identity of the virtual clock, which world and cloud share."""
VIRTUAL_RING = KeyRing(KeySet(Key(b"nothing is secret in one process")))
"""Keys of world and cloud in virtual time; with them both ends drop damaged datagrams."""


def assemble(
    experiment: ResolvedExperiment,
    make_loop: Callable[..., ControlLoop] = ControlLoop,
    transport: ControllerTransport | None = None,
    *,
    queue: Callable[[Sequence[LinkDirection]], PacketQueue] | None = None,
    compute: ComputeTime | None = None,
) -> tuple[WorldEndpoint, CloudEndpoint, Teleop, VirtualRun]:
    """Build world, cloud and teleop, and connect them for a flight in virtual time.

    The mission starts with the flight; `Teleop.over` tells when it is over. `make_loop`,
    `transport` and `compute` are those of `build_cloud`. `queue` makes the queue of the packets in
    flight on the links.
    """
    from cloudrc.flight.virtual.faults import disturbed, faulty_clock
    from cloudrc.flight.virtual.run import CPU_CLOCK, Clock, VirtualRun

    settings, faults = experiment.cloud, experiment.faults
    usual = Clock(round(settings.clock_offset_s * 1e9), settings.clock_drift_ppm)
    own = faulty_clock(usual, faults)
    links, start_ns = build_links(experiment), phase_ns(experiment)
    passes = not any(link.corrupts for link in links)  # only bytes can be damaged
    clock_id = VIRTUAL_CLOCK if own == Clock() else CLOUD_CLOCK
    of_world = Identity(VIRTUAL_CLOCK, b"world".ljust(16), VIRTUAL_RING, passes)
    world = build_world(experiment, of_world, lambda: start_ns)
    teleop = start_mission(experiment, own.at(start_ns), own)
    starts = count(1)

    def start_cloud(now_ns: int) -> CloudEndpoint:
        number = next(starts)  # a new process has another nonce
        nonce = b"cloud" if number == 1 else b"cloud %d" % number
        return build_cloud(
            experiment,
            Identity(clock_id, nonce.ljust(16), VIRTUAL_RING, passes),
            teleop,
            lambda: now_ns,
            cpu_clock=CPU_CLOCK,
            make_loop=make_loop,
            transport=transport,
            compute=compute,
        )

    cloud = start_cloud(own.at(start_ns))
    ends = (
        disturbed(world, lambda now_ns: world, acting(faults, WORLD_PAUSED), Clock()),
        disturbed(cloud, start_cloud, acting(faults, CLOUD_KILLED, CLOUD_PAUSED), own),
    )
    in_flight = queue(links) if queue else None
    run = VirtualRun(*ends, *links, cloud_clock=own, in_flight=in_flight)
    return world, cloud, teleop, run


def start_mission(
    experiment: ResolvedExperiment, now_ns: int = 0, clock: Clock | None = None
) -> Teleop:
    """Make a teleop that flies the experiment's mission from `now_ns` [ns] on, cloud's clock.

    `clock` is cloud's clock, by default virtual time.
    """
    from cloudrc.flight.virtual.faults import teleop_of
    from cloudrc.flight.virtual.run import Clock
    from cloudrc.teleop.store import MissionRecord, Order

    teleop = teleop_of(experiment.world.files.fence, experiment.faults, clock or Clock())
    order = Order(build_plan(experiment), touch=experiment.mission.touch)
    teleop.start(now_ns, MissionRecord("m1", order, ONLY_MISSION))
    return teleop


@apart()
def fly_virtual(
    experiment: ResolvedExperiment,
    see: Sink,
    gone: Callable[[], bool] = lambda: False,
) -> None:
    """Fly in virtual time until the mission is over.

    Every 100 ms of virtual time, call `see` with the new records of world and of cloud, both on
    world's clock.

    `gone` returns whether a program that controls the robot from outside has ended. Raise a
    ControllerLostError if such a program is lost.
    """
    try:
        way = _lock_step(experiment, gone)
    except ControllerLostError as error:
        see([], [Fault(0, error.code, str(error))])
        raise
    with way as transport:
        _, _, teleop, run = assemble(experiment, transport=transport)
        lost = list[ControllerLostError]()

        def sink(from_world: list[Record], from_cloud: list[Record]) -> None:
            see(from_world, run.on_world_clock(from_cloud))
            if transport is not None:
                lost.extend(lost_controller(from_cloud))

        limit_ns = round(flight_limit(experiment) * 1e9)
        run.fly(lambda: teleop.over or bool(lost), limit_ns, sink)
    if lost:
        raise lost[0]


def _lock_step(
    experiment: ResolvedExperiment, gone: Callable[[], bool]
) -> AbstractContextManager[ControllerTransport | None]:
    """Connect to the program outside that controls the robot; without one, yield None."""
    controller = build_controller(experiment)
    if not isinstance(controller, OutsideController):
        return nullcontext()
    connect = find_transport(controller.transport).get("lock_step")
    return closing(connect(controller.place, controller.start_limit, gone))


def virtual_notes(experiment: ResolvedExperiment) -> tuple[str, ...]:
    """Return warnings for the report of a flight in virtual time; () if there are none."""
    return (MEASURED,) if experiment.cloud.compute_measured else ()
