"""Run `cloudrc teleop`: the process that stores and commands missions and serves the API."""

from __future__ import annotations

import argparse
import json
import os
import resource
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from cloudrc.cli.output import print_line
from cloudrc.cli.processes import open_exporter, process_arguments, read_address, warn_if_exposed
from cloudrc.drivers.realtime import Address
from cloudrc.runs.requirements import require

if TYPE_CHECKING:
    from cloudrc.config.load import ResolvedExperiment
    from cloudrc.drivers.exporter import Exporter
    from cloudrc.geometry.scene import Scene
    from cloudrc.records import Record
    from cloudrc.teleop.api import ApiServer, Bridge
    from cloudrc.teleop.service import MissionService
    from cloudrc.teleop.store import MissionStore

FILES_MAX = 8_192
"""Limit of open files: high, because idle connections must not prevent an emergency stop."""
LOCK_PERIOD = 0.2
"""Time between two attempts to open the journal while another teleop process locks it [s]."""
PAUSE_LIMIT_NS = 500_000_000
"""When asked to end, teleop waits at most this time [ns] until the robot holds its position."""
EPILOG = """\
teleop talks to 'cloudrc cloud --teleop DIR' through two sockets in DIR. It ends
on SIGTERM, on Ctrl-C and when its parent process has ended; with --start also
after the mission. A flying robot then holds; a new teleop with the same
--journal resumes the mission.

/openapi.json describes the API. The API asks for a token, except on a socket
file, which only its owner can open. To make a token that only you can read:
(umask 077; openssl rand -hex 32 > DIR/operator). A token in DIR/reader may only
read."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    process_arguments(parser)
    where = (
        "serve the API here: [HOST:]PORT (default HOST: 127.0.0.1; PORT 0: any free port) or "
        "unix:PATH, for your user only"
    )
    for flag, metavar, kind, text in (
        ("--socket", "DIR", Path, "folder of the two sockets"),
        ("--api", "WHERE", api_address, where),
        ("--tokens", "DIR", Path, "folder of the token files 'operator' and 'reader'"),
        ("--audit", "FILE", Path, "log all commands and their callers (JSON lines)"),
        ("--api-file", "FILE", Path, "write the API's URL to this file"),
        ("--link", "FILE", Path, "state of the link: its changes go to the mission's log"),
    ):
        required = flag in ("--socket", "--api", "--audit")
        parser.add_argument(flag, type=kind, metavar=metavar, required=required, help=text)
    missions = parser.add_mutually_exclusive_group()
    journal = "store missions in this file (default: not stored)"
    missions.add_argument("--journal", type=Path, metavar="FILE", help=journal)
    start = "fly the experiment's mission, then exit"
    missions.add_argument("--start", action="store_true", help=start)


def api_address(text: str) -> Address | Path:
    """Parse [HOST:]PORT or unix:PATH for argparse; PORT 0 means any free port."""
    if text.startswith("unix:") and len(text) > len("unix:"):
        return Path(text.removeprefix("unix:"))
    host, colon, port = text.rpartition(":")
    host = host if colon else "127.0.0.1"
    return (host.strip("[]"), 0) if host and port == "0" else read_address(f"{host}:{port}")


def execute(options: argparse.Namespace) -> int:
    """Run teleop until a signal stops the process or, with --start, the mission has ended."""
    from cloudrc.config.load import read_experiment
    from cloudrc.drivers.process import GracefulStop, StopSignal
    from cloudrc.geometry.scene import load_scene
    from cloudrc.teleop.service import MissionService
    from cloudrc.teleop.store import Order

    require("the API of teleop", ("api",))
    stop, experiment = StopSignal(), read_experiment(str(options.config))
    exporter = open_exporter(options, "teleop", experiment)
    with ExitStack() as opened:
        scene = load_scene(experiment.world.scene)
        server = serve_api(options, experiment, scene)
        opened.callback(server.stop)
        book = _open_store(options.journal, stop, server.bridge)
        if book is not None:  # None: stopped while another teleop process locked the journal
            opened.callback(book.close)
            service = MissionService(experiment.criteria.contact_speed_max_mps, book, scene)
            if options.start:
                from cloudrc.assembly import build_plan

                contact = bool(experiment.criteria.contact)
                order = Order(build_plan(experiment), experiment.name, contact=contact)
                service.create(order, time.monotonic_ns())
            pause = GracefulStop(
                stop,
                lambda: service.settled,
                PAUSE_LIMIT_NS,
                lambda: service.pause(time.monotonic_ns()),
            )
            _fly(
                options,
                service,
                server,
                exporter,
                lambda: pause() or (options.start and service.over),
            )
    return 0


def serve_api(
    options: argparse.Namespace, experiment: ResolvedExperiment, scene: Scene
) -> ApiServer:
    """Start the API; until the mission service runs, the API answers that teleop is starting."""
    from cloudrc import assembly
    from cloudrc.config.robot import is_planar
    from cloudrc.files import write_atomically
    from cloudrc.teleop.api import ApiServer, Bridge, create_app
    from cloudrc.teleop.auth import Audit, Gate, Tokens
    from cloudrc.teleop.models import read_drive, read_goto, read_order

    if not isinstance(options.api, Path):
        warn_if_exposed(options.api)
    bridge, contact = Bridge(), bool(experiment.criteria.contact)
    planar = is_planar(experiment.world.robot)
    order = partial(
        read_order, scene=scene, contact=contact, planar=planar,
        plan=partial(assembly.mission_plan, speed_max=experiment.guard.speed_max_mps),
    )  # fmt: skip
    tokens = Tokens(options.tokens, log_line) if options.tokens else None
    goto = partial(read_goto, scene=scene, planar=planar)
    app = create_app(bridge, order, goto, partial(read_drive, planar=planar), log_line)
    server = ApiServer(Gate(app, tokens, Audit(options.audit, log_line)), bridge, options.api)
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    files = FILES_MAX if hard == resource.RLIM_INFINITY else min(FILES_MAX, hard)
    resource.setrlimit(resource.RLIMIT_NOFILE, (files, hard))
    server.start()
    if options.api_file is not None:
        document = {"schemaVersion": 1, "url": server.url}
        write_atomically(options.api_file, f"{json.dumps(document)}\n".encode())
    return server


def log_line(text: str) -> None:
    """Write a line to stderr, from any thread."""
    print_line(f"cloudrc teleop: {text}", sys.stderr)


def _fly(
    options: argparse.Namespace,
    service: MissionService,
    server: ApiServer,
    exporter: Exporter | None,
    over: Callable[[], bool],
) -> None:
    """Serve missions and API requests until `over()` is true."""
    from cloudrc.drivers.link_news import LinkNews
    from cloudrc.drivers.process import Feed
    from cloudrc.drivers.teleop import TeleopLoop, UnixPeer
    from cloudrc.records import Counted, Fault
    from cloudrc.teleop.wire import ALARM

    feed = Feed.on_stdout(watched=options.feed)
    paths = options.socket / "teleop.sock", options.socket / "cloud.sock"
    peer, bridge = UnixPeer(*paths), server.bridge
    bridge.alarm = lambda: peer.send(ALARM)
    bridge.open(service)

    def tell(records: Sequence[Record]) -> None:
        feed.tell(record for record in records if isinstance(record, Fault))  # cloud feeds events
        if exporter is not None:
            exporter.see(records)

    news = LinkNews(options.link) if options.link else None

    def is_over() -> bool:
        now_ns = time.monotonic_ns()
        if news is not None and (text := news.look(now_ns)):
            service.tell_link(text, now_ns)
        if exporter is not None:
            exporter.ready(service.seen is not None)
            counts = {"api_events_dropped": service.book.dropped, **server.counts}
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
    from cloudrc.teleop.store import MissionStore, StoreLockedError, connect, open_store

    salt, reported = os.urandom(16), False
    if path is None:
        return MissionStore(connect(), salt)
    while not stop():
        try:
            return open_store(path, salt)
        except StoreLockedError as error:
            if not reported:
                log_line(str(error))
                bridge.close(str(error))
            reported = True
            time.sleep(LOCK_PERIOD)
    return None
