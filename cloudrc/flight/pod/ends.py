# SPDX-License-Identifier: Apache-2.0

"""Run world or cloud as a process of a local run or a pod."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from cloudrc.base import source
from cloudrc.base.files import warn_if_readable, write_atomically
from cloudrc.base.outside.code import apart
from cloudrc.base.outside.tables import SIZE_MAX
from cloudrc.base.requirements import require
from cloudrc.cloud.controllers.remote import OutsideController
from cloudrc.config.compute import check_unshared
from cloudrc.config.load import load_experiment, read_experiment, robot_settings
from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.flight.assembly.cloud import build_cloud, build_controller
from cloudrc.flight.assembly.world import build_world
from cloudrc.flight.machine import clock_id
from cloudrc.flight.pod.background import Background
from cloudrc.flight.pod.keyfile import KeyFile
from cloudrc.flight.pod.link_monitor import LinkMonitor
from cloudrc.flight.pod.ports import ipv4_addresses, listening, open_exporter, repeat, warn
from cloudrc.flight.pod.process import EndProcess, Feed, GracefulStop, StopSignal
from cloudrc.flight.pod.readers import RecordSender
from cloudrc.flight.pod.realtime import Address, Peer, bind, show_address
from cloudrc.flight.pod.teleop_link import RemoteTeleop, UnixDatagrams, UnixPeer
from cloudrc.flight.pod.transports import find_transport
from cloudrc.link.follow import PEER_PAUSE, PeerName
from cloudrc.link.state import STATE_FILE
from cloudrc.link.traces import link_profile
from cloudrc.link.verify.judge import Flow
from cloudrc.physics.geometry.rays import scan_record
from cloudrc.results.record import part_before
from cloudrc.wire.messages import GuardState, plan_length
from cloudrc.wire.records import Fault
from cloudrc.wire.tunnel.codec import COMMAND_SIZES, TELEMETRY_SIZES, Kind
from cloudrc.wire.tunnel.end import Identity

if TYPE_CHECKING:
    from cloudrc.flight.pod.recording import Recorder
    from cloudrc.flight.pod.transports.remote import RemoteLink

TRACE_MAX = 2 << 20
"""Maximum size of a trace file whose name comes from the link process [bytes]. World and cloud do
not trust this process. In a cluster, traces come from a ConfigMap, which holds at most 1 MiB."""
FORWARD_LIMIT_NS = 800_000_000
"""Longest time for which cloud, when asked to end, still forwards teleop's request to hold [ns]. A
process has 1.5 s to end."""

SHARE = 0.45
"""Size at which a recording begins anew, as a share of the limit of both files [1]: an open chunk
comes on top."""


@dataclass(frozen=True)
class EndSettings:
    """Files and addresses of world or cloud; a field is the flag of this name."""

    config: Path  # experiment file
    record: Path  # MCAP file to record to
    listen: Address  # to receive at
    key: Path  # of the tunnel
    route: Path  # the link's file with the address to send to
    feed: bool = False  # write status for a supervisor to stdout
    metrics: Address | None = None  # serve metrics here
    record_flights: bool = False  # no periodic records while the robot does not fly
    record_max: float | None = None  # limit of both recordings [bytes]
    robot: int | None = None  # number in a fleet
    peer: Address | None = None  # where to send without a link process; its port is robot 0's


def run_world(settings: EndSettings, stop: StopSignal) -> None:
    """Run world until `stop`."""
    experiment, identity, end = open_end(settings, "world")
    world = build_world(experiment, identity, time.monotonic_ns, lambda: Background(None))
    end.run(world, stop, lambda: world.robot.guard.armed, lambda: world.slip_ns)


def run_cloud(
    settings: EndSettings, teleop_folder: Path, records_folder: Path | None, stop: StopSignal
) -> None:
    """Run cloud until `stop`.

    `teleop_folder` has the sockets between cloud and teleop, `records_folder` those of the readers
    of cloud's records: who can reach these alone cannot steer. None: the same folder.

    Raise a ControllerLostError if a program outside that controls the robot is lost, and no
    supervisor ends the flight: then a new process begins anew.
    """
    experiment, identity, end = open_end(settings, "cloud")
    paths = teleop_folder / "cloud.sock", teleop_folder / "teleop.sock"
    with (
        closing(UnixPeer(*paths)) as peer,
        _remote_link(experiment, teleop_folder) as transport,
        closing(RecordSender(records_folder or teleop_folder)) as readers,
    ):
        teleop = RemoteTeleop(peer, time.monotonic_ns())
        cloud = build_cloud(
            experiment,
            identity,
            teleop,
            time.monotonic_ns,
            transport=transport,
            make_worker=lambda extra: Background(extra.end if extra else None),
        )
        end.readers, cloud.watch = readers, readers.see
        cloud.sensors.watch_frame = lambda frame: readers.show_picture(frame.stamp_ns, frame.image)
        if (scan := experiment.robot.scan) is not None:
            cloud.sensors.watch_scan = lambda *sent: readers.show(scan_record(scan, *sent))

        def flies() -> bool:
            return cloud.guard is GuardState.TRACK

        ends = GracefulStop(stop, lambda: not flies(), FORWARD_LIMIT_NS)
        is_watched = settings.feed  # then the supervisor ends a flight without its controller
        with apart():
            end.run(cloud, lambda: ends() or bool(cloud.lost and not is_watched), flies)
        if cloud.lost and not is_watched:
            raise cloud.lost


@contextmanager
def _remote_link(experiment: ResolvedExperiment, folder: Path) -> Iterator[RemoteLink | None]:
    """Open the way to the driver of a controller outside; without such a controller, yield None."""
    controller = build_controller(experiment)
    if not isinstance(controller, OutsideController):
        yield None
        return
    require("a remote controller", ("policy",))
    from cloudrc.flight.pod.transports.remote import DATAGRAM_MAX, RemoteLink, sockets_of

    with closing(UnixDatagrams(*sockets_of(folder), DATAGRAM_MAX)) as peer:
        period = 1.0 / experiment.cloud.command_rate_hz
        yield RemoteLink(peer, period, controller.start_limit)


def run_remote(
    config: Path, folder: Path, stop: StopSignal, *, watched: bool, robot: int | None = None
) -> None:
    """Run the driver of a controller outside until `stop`.

    `folder` has the sockets between cloud and the driver. A supervisor reads the feed if it is
    `watched`. `robot` is the number in a fleet.
    """
    from cloudrc.flight.pod.transports.remote import DATAGRAM_MAX, sockets_of

    feed = Feed.on_stdout(watched=watched)
    controller = build_controller(load_experiment(str(config), robot_settings(robot)))
    assert isinstance(controller, OutsideController), "the supervisor starts it for no other"
    other, own = sockets_of(folder)
    with closing(UnixDatagrams(own, other, DATAGRAM_MAX)) as peer:

        def tell(text: str) -> None:
            feed.tell([Fault(time.monotonic_ns(), "controller_unstamped", text)])

        connect = find_transport(controller.transport).get("driver")
        driver = connect(peer, controller.place, controller.start_limit, tell)
        driver.run(feed.alive_while(stop))


def open_end(settings: EndSettings, name: str) -> tuple[ResolvedExperiment, Identity, EndProcess]:
    """Open the files and sockets of world or cloud; `name` is "world" or "cloud".

    Return the experiment, the identity of the process in the tunnel, and the `EndProcess` to run.
    """
    feed = Feed.on_stdout(watched=settings.feed)  # before plug-ins are loaded: they may print
    path, clock, key = str(settings.config), clock_id(), settings.key
    own = robot_settings(settings.robot)
    given = read_experiment(path, own)
    if settings.robot is not None:
        check_unshared(given.cloud)
    exporter = open_exporter(name, given, settings.metrics)
    # Only cloud loads the plug-ins, which fill in their default parameters.
    experiment = load_experiment(path, own) if name == "cloud" else given
    keys = KeyFile(key, time.monotonic_ns(), settings.robot)
    warn_if_readable(key, warn)
    link = settings.route.with_name(STATE_FILE)
    if settings.peer:
        host, port = settings.peer
        follow_peer((host, port + (settings.robot or 0)), settings.route)
    with listening("--listen", settings.listen):
        peer = Peer(bind(settings.listen), settings.route)
    attached = dict[str, bytes]()
    if name == "world":
        from cloudrc.results.report.shapes import flown_files

        attached = flown_files(experiment.world)
    recorder = open_recorder(settings.record, settings.record_max, name, clock, attached)
    end = EndProcess(
        end=name,
        peer=peer,
        recorder=recorder,
        keys=keys,
        feed=feed,
        exporter=exporter,
        flights_only=settings.record_flights,
        link=link,
        check=link_monitor(experiment, uplink=name == "cloud", trusted=settings.feed),
    )
    return experiment, Identity(clock, os.urandom(16), keys.ring), end


def follow_peer(peer: Address, route: Path) -> None:
    """Keep the address of `peer` in the file `route`, as a link process does, on a thread."""
    name, written = PeerName(peer, ipv4_addresses, warn), None

    def look() -> None:
        nonlocal written
        if (found := name.poll()) != written and found:
            write_atomically(route, f"{show_address(found)}\n".encode())
            written = found

    repeat(look, *PEER_PAUSE)


def open_recorder(
    path: Path,
    limit: float | None,
    clock: str,
    clock_id: bytes,
    attached: Mapping[str, bytes],
) -> Recorder:
    """Make the recorder of world or cloud, which writes to `path`.

    The recording of a previous process is kept as NAME.before.mcap, because it may show why that
    process ended; so is a file that reaches its share of `limit`, the largest size of both
    together [bytes]. `clock` is "world" or "cloud", the clock of the stamps; `clock_id` identifies
    this machine's monotonic clock. `attached` are files to attach: name -> content.
    """
    require("a recording", ("record",))
    from cloudrc.flight.pod.recording import Recorder
    from cloudrc.results.record.writer import McapWriter

    if path.is_file() and path.stat().st_size:
        path.replace(part_before(path))
    size_max = round(SHARE * limit) if limit else None
    offset_ns = time.time_ns() - time.monotonic_ns()

    def open_file(file: Path) -> McapWriter:
        writer = McapWriter(
            file,
            clock=clock,
            clock_id=clock_id.hex(),
            wall_offset_ns=offset_ns,
            code=source.code_hash(),
            index=False,
        )
        for name, data in attached.items():
            writer.attach(name, data)
        return writer

    return Recorder(path, open_file, size_max=size_max)


def link_monitor(experiment: ResolvedExperiment, *, uplink: bool, trusted: bool) -> LinkMonitor:
    """Make the monitor that compares the received datagrams with the link profile.

    `uplink` is True in cloud, False in world. If the link is not `trusted`, as in a pod, the
    monitor reads no trace files larger than TRACE_MAX. It does not know how long packets
    wait in a cell, so it does not judge a link behind one.
    """
    kind = Kind.TELEMETRY if uplink else Kind.COMMAND
    rate = experiment.world.odometry_rate_hz if uplink else experiment.cloud.command_rate_hz
    size = COMMAND_SIZES[plan_length(experiment.cloud.plan_s)]
    if uplink:
        size = TELEMETRY_SIZES[len(experiment.robot.sensors)]
    flow = Flow(experiment.seed, uplink, kind, size, experiment.stream)
    computes, file_max = bool(experiment.cloud.compute_ms), SIZE_MAX if trusted else TRACE_MAX
    check = LinkMonitor(uplink, flow, period=1.0 / rate, computes=computes, file_max=file_max)
    if experiment.cell.rate_kbit is None:
        check.begin((link_profile(experiment.uplink), link_profile(experiment.downlink)))
    return check
