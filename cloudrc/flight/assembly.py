# SPDX-License-Identifier: Apache-2.0

"""Build world, cloud and link from an experiment, and convert its values to SI units.

World and cloud do not import each other. Drivers use them only through
`wire.endpoint.Endpoint`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, closing, nullcontext
from dataclasses import replace
from functools import partial
from itertools import count
from math import degrees, inf
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cloudrc.base.errors import ControllerLostError
from cloudrc.base.outside.code import apart
from cloudrc.cloud.compute_time import ComputeTime, compute_time
from cloudrc.cloud.controllers import Controller
from cloudrc.cloud.controllers.remote import ControllerTransport, OutsideController
from cloudrc.cloud.endpoint import CloudEndpoint
from cloudrc.cloud.loop import ControlLoop
from cloudrc.cloud.news import SendOnDelta
from cloudrc.cloud.operator import Operator
from cloudrc.cloud.perceiving import Here, Perceiver
from cloudrc.cloud.planar import Planar
from cloudrc.config import schema
from cloudrc.config.faults import CLOUD_KILLED, CLOUD_PAUSED, WORLD_PAUSED, acting
from cloudrc.config.link_schedule import find_ways
from cloudrc.config.mission_check import start_of
from cloudrc.config.overrides import build_plugin
from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.config.setpoints import DRIVE_FILE, read_setpoints
from cloudrc.flight.drivers.transports import find_transport
from cloudrc.flight.legs import LEG_FACTOR, leg_to, step_legs
from cloudrc.flight.sensing import build_frame_source, build_receiver, build_scanner, build_target
from cloudrc.link.cell import FRAME_NS, Bulk, Cell, Video
from cloudrc.link.model import LinkDirection
from cloudrc.link.profile import DIRECTIONS
from cloudrc.link.queue import PacketQueue
from cloudrc.physics.geometry.rays import angles_of
from cloudrc.teleop.mission import Teleop
from cloudrc.teleop.wire import Leg, Plan
from cloudrc.wire.endpoint import Worker
from cloudrc.wire.messages import Start
from cloudrc.wire.records import CONTROLLER_LOST, Fault
from cloudrc.wire.tunnel.end import Identity
from cloudrc.wire.tunnel.keys import Key, KeyRing, KeySet

if TYPE_CHECKING:
    from cloudrc.flight.drivers.virtual import Clock, Sink, VirtualRun
    from cloudrc.teleop.store import Order
    from cloudrc.wire.records import Record
    from cloudrc.world.endpoint import WorldEndpoint

SECOND_NS = 1_000_000_000
CLOUD_CLOCK = b"cloud".ljust(16)
"""Identity of cloud's clock in virtual time, if it differs from world's clock."""
MEASURED = "Not repeatable: cloud.compute_measured uses the processor time of this machine."
LIMIT_MIN = 60.0
"""Smallest time limit of a mission whose order gives none [s]."""
ONLY_MISSION = 1
"""Mission number in virtual time, where teleop flies only one mission."""
GRACE = 30.0
"""Time after the end of the mission's time limit at which a flight is stopped [s]."""
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
    from cloudrc.flight.drivers.faults import disturbed, faulty_clock
    from cloudrc.flight.drivers.virtual import CPU_CLOCK, Clock, VirtualRun

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
    from cloudrc.flight.drivers.faults import teleop_of
    from cloudrc.flight.drivers.virtual import Clock
    from cloudrc.teleop.store import MissionRecord, Order

    teleop = teleop_of(experiment.world.files.fence, experiment.faults, clock or Clock())
    order = Order(build_plan(experiment), touch=experiment.mission.touch)
    teleop.start(now_ns, MissionRecord("m1", order, ONLY_MISSION))
    return teleop


@apart()
def fly(
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


def lost_controller(records: Iterable[Record]) -> Iterator[ControllerLostError]:
    """Yield the faults in cloud's records with which a flight ends, as errors."""
    for record in records:
        if isinstance(record, Fault) and record.code in CONTROLLER_LOST:
            yield ControllerLostError(record.code, record.text)


def step_code(experiment: ResolvedExperiment) -> str:
    """Say what runs the usual physics steps: "C" with a hash of the machine code, or "Python"."""
    from cloudrc.robots.build import accelerator

    faster = accelerator(experiment.world)
    return f"C {faster.code}" if faster and faster.make else "Python"


def virtual_notes(experiment: ResolvedExperiment) -> tuple[str, ...]:
    """Return warnings for the report of a flight in virtual time; () if there are none."""
    return (MEASURED,) if experiment.cloud.compute_measured else ()


def flight_limit(experiment: ResolvedExperiment) -> float:
    """Return the time after which a flight is stopped [s]."""
    return build_plan(experiment).time_limit + GRACE


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


def build_links(
    experiment: ResolvedExperiment, origin_ns: int = 0
) -> tuple[LinkDirection, LinkDirection]:
    """Build the uplink and the downlink of the link, which come up at `origin_ns` [ns]."""
    up, down, start_ns = find_ways(experiment)
    if experiment.cell.rate_kbit is not None:  # packets get their order behind the cell
        up, down = replace(up, keep_order=False), replace(down, keep_order=False)
    seed, stream = experiment.seed, experiment.stream
    return (
        LinkDirection(up, seed, uplink=True, origin_ns=origin_ns - start_ns, stream=stream),
        LinkDirection(down, seed, uplink=False, origin_ns=origin_ns - start_ns, stream=stream),
    )


def build_cells(experiment: ResolvedExperiment, origin_ns: int = 0) -> list[Cell]:
    """Build the cell of each direction, or one for both, with the traffic of others.

    The traffic begins at `origin_ns` [ns].
    """
    given = experiment.cell
    if given.rate_kbit is None:
        return []
    limits = given.queue, given.queue_packets, round(given.airtime_us * 1e3)
    ways = ["both"] if given.shared else DIRECTIONS
    cells = [Cell(given.rate_kbit * 1e3, *limits, way) for way in ways]
    for flow, each in enumerate(given.traffic, start=-len(given.traffic)):
        start_ns = int(generator(experiment.seed, f"traffic {flow}").integers(FRAME_NS))
        video = Video(flow, each.rate_kbit * 1e3, origin_ns + start_ns)
        source = video if each.kind == "video" else Bulk(flow, origin_ns + start_ns)
        cells[-1 if each.direction == "downlink" else 0].traffic[flow] = source
    return cells


def phase_ns(experiment: ResolvedExperiment) -> int:
    """Return the time at which a robot and its cloud begin [ns]: 0, but for robots of a fleet."""
    if not experiment.stream or experiment.fleet.phase == "equal":
        return 0
    slower = min(experiment.world.odometry_rate_hz, experiment.cloud.command_rate_hz)
    draws = generator(experiment.seed, "phase", experiment.stream)
    return int(draws.integers(SECOND_NS // slower))


def build_plan(
    experiment: ResolvedExperiment,
    mission: schema.MissionConfig | None = None,
    time_limit: float | None = None,
) -> Plan:
    """Convert a valid mission, by default that of the experiment, to a plan for teleop.

    `time_limit` is that of another mission [s]; None: as long as the mission may need.
    """
    if mission is None:
        mission, time_limit = experiment.mission, experiment.criteria.time_limit_s
    fence = experiment.world.files.fence
    track = read_setpoints(Path(mission.setpoints), fence) if mission.setpoints else ()
    if (follow := mission.follow) is not None:
        place = start_of(follow, experiment.scene, planar=experiment.robot.planar)
        track = (0.0, place), (follow.duration_s, place)
    if track:
        legs: tuple[Leg, ...] = (Leg(track[0][1], tolerance=inf, time_limit=inf),)
        needed = LEG_FACTOR * track[-1][0]
    elif mission.steps is not None:
        legs = step_legs(mission.steps, generator(experiment.seed, "steps", experiment.stream))
        needed = LEG_FACTOR * mission.steps.count * mission.steps.period_s
    else:
        points = mission.waypoints
        legs = tuple(
            leg_to(before, waypoint, fence, experiment.guard, mission.carrot)
            for before, waypoint in zip((None, *points), points, strict=False)
        )
        needed = sum(leg.time_limit for leg in legs)
    start = Start.SPAWN if mission.start == "spawn" else Start.HERE
    limit = time_limit or max(LIMIT_MIN, needed)
    return Plan(legs, start, limit, track=track, judged_by=mission.judged_by, follow=follow)


def with_order(
    experiment: ResolvedExperiment, order: Order, description: str
) -> ResolvedExperiment:
    """Return the experiment with an operator's order as its mission, for report and repetition.

    If the order is a drive by hand, the mission reads its setpoints from the file `DRIVE_FILE`.
    """
    legs, carrot = order.plan.legs, None
    if speed := max(leg.speed for leg in legs):
        carrot = schema.Carrot(speed_mps=speed, acceleration_mps2=legs[0].acceleration)
    waypoints = tuple(
        schema.Waypoint(
            position_m=leg.position,
            yaw_deg=None if leg.yaw is None else round(degrees(leg.yaw), 9),
            yaw_tolerance_deg=None if leg.yaw is None else round(degrees(leg.yaw_tolerance), 9),
            tolerance_m=leg.tolerance,
            dwell_s=leg.dwell,
            time_limit_s=leg.time_limit,
            speed_mps=leg.speed or None,
        )
        for leg in ([] if order.plan.by_hand or order.plan.follow else legs)
    )
    mission = schema.MissionConfig(
        start="spawn" if order.plan.start is Start.SPAWN else "here",
        waypoints=waypoints,
        setpoints=DRIVE_FILE if order.plan.by_hand else None,
        follow=order.plan.follow,
        carrot=carrot,
        judged_by=order.plan.judged_by,
        touch=order.touch,
    )
    judged = {"time_limit_s": order.plan.time_limit}
    criteria = experiment.criteria.model_copy(update=judged)
    changed = {"mission": mission, "criteria": criteria, "description": description}
    return experiment.model_copy(update=changed)


def generator(seed: int, *names: str) -> np.random.Generator:
    """Make a random number generator; generators with different `names` are independent."""
    stream = " ".join(filter(None, names))
    return np.random.Generator(np.random.PCG64([seed, int.from_bytes(stream.encode(), "little")]))
