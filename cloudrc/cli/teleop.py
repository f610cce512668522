"""Run `cloudrc teleop`: the process that flies missions, with its API and its stored missions."""

from __future__ import annotations

import argparse
import json
import os
import resource
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cloudrc.cli.extras import require
from cloudrc.cli.output import print_line
from cloudrc.cli.processes import (
    open_exporter,
    process_arguments,
    read_address,
    warn_if_exposed,
)
from cloudrc.drivers.realtime import Address

if TYPE_CHECKING:
    from cloudrc.config.load import ResolvedExperiment
    from cloudrc.drivers.exporter import Exporter
    from cloudrc.records import Counted
    from cloudrc.teleop.api import ApiServer
    from cloudrc.teleop.bridge import Bridge
    from cloudrc.teleop.service import MissionService
    from cloudrc.teleop.store import MissionStore


LOOPBACK = "127.0.0.1"
FILES_MAX = 8_192
"""Limit of open files. It is high enough that idle connections leave room for an emergency stop.
Idle connections use at most 64 MB of memory."""


def serve_api(
    options: argparse.Namespace, experiment: ResolvedExperiment, bridge: Bridge
) -> ApiServer:
    """Start the API; until the bridge is opened, the API answers that teleop is not ready."""
    from cloudrc import assembly
    from cloudrc.geometry.scene import load_scene
    from cloudrc.link.state import publish
    from cloudrc.teleop.api import ApiServer, create_app
    from cloudrc.teleop.audit import Audit
    from cloudrc.teleop.auth import Gate, Tokens
    from cloudrc.teleop.models import Surroundings

    if not isinstance(options.api, Path):
        warn_if_exposed(options.api)
    criteria, scene = experiment.criteria, load_scene(experiment.world.scene)
    plan = partial(assembly.mission_plan, speed_max=experiment.guard.speed_max_mps)
    surroundings = Surroundings(scene, criteria.time_limit_s, criteria.contact, plan)
    tokens = Tokens(options.tokens, log_line) if options.tokens else None
    audit = Audit(options.audit, log_line) if options.audit else None
    gate = Gate(create_app(bridge, surroundings, log_line), tokens, audit)
    server = ApiServer(gate, bridge, options.api)
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    files = FILES_MAX if hard == resource.RLIM_INFINITY else min(FILES_MAX, hard)
    resource.setrlimit(resource.RLIMIT_NOFILE, (files, hard))
    server.start()
    if options.api_file is not None:
        publish(options.api_file, json.dumps({"schemaVersion": 1, "url": server.url}) + "\n")
    return server


def api_counts(server: ApiServer, service: MissionService) -> list[Counted]:
    """Return the counts of the API for the metrics."""
    from cloudrc.records import Counted

    counts, now_ns = {**server.counts, "events_dropped": service.book.dropped}, time.monotonic_ns()
    return [Counted(now_ns, "teleop", f"api_{name}", number) for name, number in counts.items()]


def log_line(text: str) -> None:
    """Write a line to the log, from any thread."""
    print_line(f"cloudrc teleop: {text}", sys.stderr)


def api_address(text: str) -> Address | Path:
    """Parse [HOST:]PORT, where PORT may be 0, or unix:PATH."""
    if text.startswith("unix:") and len(text) > len("unix:"):
        return Path(text.removeprefix("unix:"))
    host, colon, port = text.rpartition(":")
    host = host if colon else LOOPBACK
    return (host.strip("[]"), 0) if host and port == "0" else read_address(f"{host}:{port}")


EPILOG = """\
teleop talks to 'cloudrc cloud --teleop DIR' through two sockets in DIR. With
--start or --mission it ends after that mission; otherwise on SIGTERM, on Ctrl-C
and when its parent process has ended. A flying robot then holds; a new teleop
with the same --journal resumes the mission.

/openapi.json describes the API. The API asks for a token, except on a socket
file, which only its owner can open. To make a token that only you can read:
(umask 077; openssl rand -hex 32 > DIR/operator). A token in DIR/reader may only
read."""
LOCK_PERIOD = 0.2
"""Pause between two attempts to open a journal that another teleop process has locked [s]."""
PAUSE_LIMIT_NS = 500_000_000
"""Longest time that teleop, before it ends, waits for the robot to hold [ns]."""
SALT_SIZE = 16
"""Size of the random salt of mission numbers [bytes]."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    process_arguments(parser)
    parser.add_argument(
        "--socket", type=Path, required=True, metavar="DIR", help="folder of the two sockets"
    )
    parser.add_argument(
        "--api",
        type=api_address,
        metavar="WHERE",
        help="serve the API here: [HOST:]PORT (default HOST: 127.0.0.1; PORT 0: any free port) or "
        "unix:PATH, for your user only (default: no API)",
    )
    parser.add_argument(
        "--tokens",
        type=Path,
        metavar="DIR",
        help="folder of the token files 'operator' and 'reader'",
    )
    parser.add_argument(
        "--audit", type=Path, metavar="FILE", help="log all commands and their callers (JSON lines)"
    )
    parser.add_argument(
        "--api-file", type=Path, metavar="FILE", help="write the API's URL to this file"
    )
    parser.add_argument(
        "--journal",
        type=Path,
        metavar="FILE",
        help="store missions in this file (default: not stored)",
    )
    first = parser.add_mutually_exclusive_group()
    first.add_argument("--mission", metavar="FILE", help="fly this mission, then exit")
    first.add_argument(
        "--start", action="store_true", help="fly the experiment's mission, then exit"
    )


def execute(options: argparse.Namespace) -> int:
    """Run teleop until its mission has ended or a signal stops the process."""
    from cloudrc.config.load import fingerprint, read_experiment
    from cloudrc.drivers.process import StopSignal
    from cloudrc.records import Counted
    from cloudrc.teleop.bridge import Bridge
    from cloudrc.teleop.service import MissionService

    if options.api:
        require("the API of teleop", ("api",))
    stop, exporter = StopSignal(), open_exporter(options, "teleop")
    experiment = read_experiment(str(options.config))
    if exporter is not None:
        exporter.runs(fingerprint(experiment))
    bridge = Bridge()
    server = serve_api(options, experiment, bridge) if options.api else None
    book = None
    try:
        book = _open_store(options.journal, stop, bridge)
        if book is None:
            return 0  # stopped while another teleop held the journal
        service = MissionService(experiment.criteria.contact_speed_max_mps, book)
        single_mission = _start(options, experiment, service)
        ending = _Ending(service, stop)
        over = lambda: ending() or (single_mission and service.over)  # noqa: E731
        if exporter is not None and book.damaged:
            exporter.see([Counted(0, "teleop", "journal_repaired", 1)])
        _fly(options, service, bridge, server, exporter, over)
    finally:
        if server is not None:
            server.stop()
        if book is not None:
            book.close()
    return 0


class _Ending:
    """Pause the mission after a stop signal; return True once the robot holds.

    It also returns True after `PAUSE_LIMIT_NS`.
    """

    def __init__(self, service: MissionService, asked: Callable[[], bool]) -> None:
        self._service, self._stop_asked = service, asked
        self._since_ns: int | None = None

    def __call__(self) -> bool:
        if not self._stop_asked():
            return False
        if self._since_ns is None:
            self._service.pause(time.monotonic_ns())
            self._since_ns = time.monotonic_ns()  # the disk may have taken long
        return self._service.settled or time.monotonic_ns() - self._since_ns > PAUSE_LIMIT_NS


def _fly(
    options: argparse.Namespace,
    service: MissionService,
    bridge: Bridge,
    server: ApiServer | None,
    exporter: Exporter | None,
    stop: Callable[[], bool],
) -> None:
    """Run the service until `stop()`."""
    from cloudrc.drivers.process import Feed
    from cloudrc.drivers.teleop import UnixPeer, serve_teleop
    from cloudrc.records import Fault
    from cloudrc.teleop import wire

    feed = Feed.on_stdout(watched=options.feed)
    peer = UnixPeer(options.socket / "teleop.sock", options.socket / "cloud.sock")
    bridge.alarm = lambda: peer.send(wire.encode(wire.ALARM))
    bridge.open(service)
    feed.ready()

    def publish(records: list[Any]) -> None:
        feed.tell(record for record in records if isinstance(record, Fault))  # cloud has events
        if exporter is not None:
            exporter.see(records)

    def update_and_check() -> bool:
        if exporter is not None:
            exporter.ready(service.sight.seen is not None)
            if server is not None:
                exporter.see(api_counts(server, service))
        return stop()

    if notice := service.book.notice:
        publish([Fault(0, "journal", notice)])
    serve_teleop(
        service,
        peer,
        wire.encode,
        wire.decode,
        calls=bridge.take,
        stops=bridge.take_urgent,
        tell=publish,
        stop=feed.alive_while(update_and_check),
    )


def _open_store(path: Path | None, stop: Callable[[], bool], bridge: Bridge) -> MissionStore | None:
    """Open the store once no other teleop has locked it; return None if stopped before."""
    from cloudrc.teleop.store import MissionStore, StoreLockedError, connect, open_store

    salt, reported = os.urandom(SALT_SIZE), False
    if path is None:
        return MissionStore(connect(), salt)
    while not stop():
        try:
            book = open_store(path, salt)
        except StoreLockedError as error:
            if not reported:
                log_line(str(error))
                reported = True
            bridge.close(str(error))
            time.sleep(LOCK_PERIOD)
            continue
        if book.notice:
            log_line(book.notice)
        return book
    return None


def _start(
    options: argparse.Namespace, experiment: ResolvedExperiment, service: MissionService
) -> bool:
    """Start the mission of the command line, if any; return whether teleop flies it."""
    from cloudrc import assembly
    from cloudrc.teleop.store import ConflictError, Order

    if not (options.start or options.mission):
        return False
    criteria, mission, name = experiment.criteria, experiment.mission, experiment.name
    if options.mission:
        mission, name = _load(options.mission, experiment), Path(options.mission).stem
    plan = assembly.mission_plan(mission, criteria.time_limit_s, experiment.seed)
    if any(each.order.plan == plan for each in service.book.open()):
        return True  # the previous process started it with the same options: it resumes
    try:
        service.create(Order(plan, name, contact=criteria.contact), time.monotonic_ns())
    except ConflictError as error:
        if not options.api:
            raise
        log_line(str(error))
        return False  # the operator can solve the conflict through the API
    return True


def _load(name: str, experiment: ResolvedExperiment) -> Any:
    from cloudrc.config.load import load_mission
    from cloudrc.config.mission_check import check_mission
    from cloudrc.errors import BadInputError
    from cloudrc.geometry.scene import load_scene

    mission = load_mission(name)
    problems = check_mission(mission, load_scene(experiment.world.scene))
    if problems:
        raise BadInputError("\n  ".join([f"{name} cannot be flown:", *map(str, problems)]))
    return mission
