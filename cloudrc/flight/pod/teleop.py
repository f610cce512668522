# SPDX-License-Identifier: Apache-2.0

"""Run the process that stores and commands missions and serves the API."""

from __future__ import annotations

import json
import os
import resource
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from cloudrc.base.files import write_atomically
from cloudrc.config.load import read_experiment, robot_settings
from cloudrc.flight.assembly.plan import build_plan
from cloudrc.flight.pod.link_news import LinkNews
from cloudrc.flight.pod.ports import open_exporter, warn, warn_if_exposed
from cloudrc.flight.pod.process import Feed, GracefulStop, StopSignal
from cloudrc.flight.pod.realtime import Address
from cloudrc.flight.pod.teleop_link import TeleopLoop, UnixPeer
from cloudrc.teleop.api import ApiServer, Bridge, create_app
from cloudrc.teleop.auth import Gate, Tokens
from cloudrc.teleop.models import RequestReader
from cloudrc.teleop.service import MissionService
from cloudrc.teleop.store import MissionStore, Order, StoreLockedError, connect, open_store
from cloudrc.teleop.wire import ALARM
from cloudrc.wire.records import Counted, Fault, Record

if TYPE_CHECKING:
    from cloudrc.flight.pod.exporter import Exporter

FILES_MAX = 8_192
"""Limit of open files: high, because idle connections must not prevent an emergency stop."""
LOCK_PERIOD = 0.2
"""Time between two attempts to open the journal while another teleop process locks it [s]."""
PAUSE_LIMIT_NS = 500_000_000
"""When asked to end, teleop waits at most this time [ns] until the robot holds its position."""
log_line = partial(warn, process="teleop")


@dataclass(frozen=True)
class TeleopSettings:
    """Files and addresses of the process; a field is the flag of this name."""

    config: Path  # experiment file
    socket: Path  # folder of the sockets between teleop and cloud
    api: Address | Path  # where to serve the API
    tokens: Path | None = None  # folder of the token files
    api_file: Path | None = None  # file for the API's URL
    link: Path | None = None  # state of the link
    journal: Path | None = None  # file of the missions; None: not stored
    start: bool = False  # fly the experiment's mission, then exit
    feed: bool = False  # write status for a supervisor to stdout
    metrics: Address | None = None  # serve metrics here
    robot: int | None = None  # number in a fleet


def run_teleop(settings: TeleopSettings, stop: StopSignal) -> None:
    """Run teleop until `stop` or, with `start`, until the mission has ended."""
    experiment = read_experiment(str(settings.config), robot_settings(settings.robot))
    exporter = open_exporter("teleop", experiment, settings.metrics)
    plan, touch = partial(build_plan, experiment), experiment.mission.touch
    reader = RequestReader(experiment.world.files, plan, touch)
    with ExitStack() as opened:
        server = _serve_api(settings, reader)
        opened.callback(server.stop)
        book = _open_store(settings.journal, stop, server.bridge)
        if book is None:  # stopped while another teleop process locked the journal
            return
        opened.callback(book.close)
        files, limit = experiment.world.files, experiment.guard.speed_max_mps
        units = {name: each.unit for name, each in files.robot.sensors.items()}
        place = files.fence, files.scene, files.hull
        service = MissionService(book, *place, units, speed_max=limit)
        if settings.start and not book.missions:  # else an earlier process has begun it
            order = Order(build_plan(experiment), experiment.name, touch=touch)
            service.create(order, time.monotonic_ns())
        pause = GracefulStop(
            stop,
            lambda: service.settled,
            PAUSE_LIMIT_NS,
            lambda: service.pause(time.monotonic_ns()),
        )

        def over() -> bool:
            return pause() or (settings.start and service.over)

        _fly(settings, service, server, exporter, over)


def _serve_api(settings: TeleopSettings, reader: RequestReader) -> ApiServer:
    """Start the API; until the mission service runs, the API answers that teleop is starting."""
    if not isinstance(settings.api, Path):
        warn_if_exposed(settings.api)
    bridge = Bridge()
    tokens = Tokens(settings.tokens, log_line) if settings.tokens else None
    gate = Gate(create_app(bridge, reader, log_line), tokens, log_line)
    server = ApiServer(gate, bridge, settings.api)
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    files = FILES_MAX if hard == resource.RLIM_INFINITY else min(FILES_MAX, hard)
    resource.setrlimit(resource.RLIMIT_NOFILE, (files, hard))
    server.start()
    if settings.api_file is not None:
        document = {"schemaVersion": 1, "url": server.url}
        write_atomically(settings.api_file, f"{json.dumps(document)}\n".encode())
    return server


def _fly(
    settings: TeleopSettings,
    service: MissionService,
    server: ApiServer,
    exporter: Exporter | None,
    over: Callable[[], bool],
) -> None:
    """Serve missions and API requests until `over()` is true."""
    feed = Feed.on_stdout(watched=settings.feed)
    paths = settings.socket / "teleop.sock", settings.socket / "cloud.sock"
    peer, bridge = UnixPeer(*paths), server.bridge
    bridge.alarm = lambda: peer.send(ALARM)
    bridge.open(service)

    def tell(records: Sequence[Record]) -> None:
        feed.tell(record for record in records if isinstance(record, Fault))  # cloud feeds events
        if exporter is not None:
            exporter.see(records)

    news = LinkNews(settings.link) if settings.link else None

    def is_over() -> bool:
        now_ns = time.monotonic_ns()
        if news is not None and (text := news.look(now_ns)):
            service.tell_link(text, now_ns)
        if exporter is not None:
            exporter.ready(service.seen is not None)
            counts = {"api_events_dropped": service.book.dropped, **server.counts}
            counts["missions_failed"] = service.failed
            exporter.see([Counted(0, "teleop", name, count) for name, count in counts.items()])
        return over()

    if notice := service.book.notice:
        tell([Fault(0, "journal", notice), Counted(0, "teleop", "journal_repaired", 1)])
    loop = TeleopLoop(service, peer, tell, calls=bridge.make_calls, stops=bridge.make_stops)
    loop.run(feed.alive_while(is_over))


def _open_store(path: Path | None, stop: Callable[[], bool], bridge: Bridge) -> MissionStore | None:
    """Open the journal of missions at `path`, or make a store in memory if `path` is None.

    Wait while another teleop process locks the file; return None if `stop()` becomes true first.
    """
    salt = os.urandom(16)
    if path is None:
        return MissionStore(connect(), salt)
    while not stop():
        try:
            return open_store(path, salt)
        except StoreLockedError as error:
            if bridge.closed != str(error):
                log_line(str(error))
                bridge.close(str(error))
            time.sleep(LOCK_PERIOD)
    return None
