"""`cloudrc teleop`: the process that flies missions; its API is where they come from."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cloudrc.cli.ends import Address, open_exporter, process_arguments, warn_if_exposed
from cloudrc.cli.extras import require

if TYPE_CHECKING:
    from cloudrc.cloud.teleop.api_bridge import Bridge
    from cloudrc.cloud.teleop.api_server import ApiServer
    from cloudrc.cloud.teleop.journal import Journal
    from cloudrc.cloud.teleop.service import MissionService
    from cloudrc.config.resolved import ResolvedExperiment
    from cloudrc.drivers.exporter import Exporter

EPILOG = """\
It talks to 'cloudrc cloud --teleop DIR' through two sockets in DIR. With
--start or --mission it ends once that is flown; else on SIGTERM, on Ctrl-C,
and when the process that started it is gone. The API describes itself: /docs."""
LOCK_PERIOD = 0.2
"""Between two tries to get the journal [s]."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    process_arguments(parser)
    parser.add_argument(
        "--socket", type=Path, required=True, metavar="DIR", help="folder of the two sockets"
    )
    parser.add_argument(
        "--api",
        type=_api_address,
        metavar="HOST:PORT",
        help="serve the API here; port 0: any (default: not at all)",
    )
    parser.add_argument("--api-file", type=Path, metavar="FILE", help="write the API's URL here")
    parser.add_argument(
        "--journal", type=Path, metavar="FILE", help="keep missions here (default: nowhere)"
    )
    first = parser.add_mutually_exclusive_group()
    first.add_argument("--mission", metavar="FILE", help="fly this mission, then end")
    first.add_argument(
        "--start", action="store_true", help="fly the experiment's mission, then end"
    )


def execute(options: argparse.Namespace) -> int:
    """Fly missions."""
    from cloudrc.config.load import load_experiment
    from cloudrc.drivers.process import StopSignal

    if options.api:
        require("the API of teleop", ("api",))
    stop, exporter = StopSignal(), open_exporter(options, "teleop")
    experiment = load_experiment(str(options.config))
    bridge, server = _serve_api(options, experiment) if options.api else (None, None)
    journal = _open_journal(options.journal, stop, bridge) if options.journal else None
    if options.journal and journal is None:
        return 0  # stopped while another one had it
    try:
        service = _open_service(experiment, journal)
        ends = _start(options, experiment, service)
        _fly(options, service, bridge, exporter, lambda: stop() or (ends and service.over))
    finally:
        if server is not None:
            server.stop()
        if journal is not None:
            journal.close()
    return 0


def _fly(
    options: argparse.Namespace,
    service: MissionService,
    bridge: Bridge | None,
    exporter: Exporter | None,
    stop: Callable[[], bool],
) -> None:
    """Run the service until `stop()`."""
    from cloudrc.cloud.teleop import wire
    from cloudrc.drivers.feed import Feed
    from cloudrc.drivers.teleop import serve_teleop
    from cloudrc.drivers.unix import UnixPeer
    from cloudrc.records import Fault

    feed = Feed.on_stdout(watched=options.feed)
    peer = UnixPeer(options.socket / "teleop.sock", options.socket / "cloud.sock")
    calls: Callable[[], Iterable[Callable[[int], None]]] = list
    if bridge is not None:
        bridge.open(service)
        calls = bridge.take
    feed.ready()

    def tell(told: list[Any]) -> None:
        feed.tell(record for record in told if isinstance(record, Fault))  # cloud tells events
        if exporter is not None:
            exporter.see(told)

    def ask() -> bool:
        if exporter is not None:
            exporter.ready(service.seen)
        return stop()

    serve_teleop(service, peer, wire.encode, wire.decode, calls=calls, tell=tell, stop=ask)


def _serve_api(
    options: argparse.Namespace, experiment: ResolvedExperiment
) -> tuple[Bridge, ApiServer]:
    """Answer from now on, if only that teleop is not ready yet."""
    from cloudrc import assembly
    from cloudrc.cloud.teleop.api import Surroundings, create_app
    from cloudrc.cloud.teleop.api_bridge import Bridge
    from cloudrc.cloud.teleop.api_server import ApiServer
    from cloudrc.geometry.scene import load_scene

    warn_if_exposed(options.api)
    criteria, bridge = experiment.criteria, Bridge()
    scene = load_scene(experiment.world.scene)
    surroundings = Surroundings(
        scene, criteria.time_limit_s, criteria.contact, assembly.mission_plan
    )
    server = ApiServer(create_app(bridge, surroundings), bridge, options.api)
    server.start()
    if options.api_file is not None:
        _write_url(options.api_file, server.url)
    return bridge, server


def _write_url(path: Path, url: str) -> None:
    """Write it in one step: who waits for the file finds it whole."""
    import json

    new = path.with_name(f"{path.name}.new")
    new.write_text(json.dumps({"schemaVersion": 1, "url": url}) + "\n", encoding="utf-8")
    new.replace(path)


def _open_journal(path: Path, stop: Callable[[], bool], bridge: Bridge | None) -> Journal | None:
    """Wait for the journal as long as another teleop holds it; None if told to stop."""
    import time

    from cloudrc.cloud.teleop.journal import Journal, JournalLockedError

    said = False
    while not stop():
        try:
            journal = Journal(path)
        except JournalLockedError as error:
            if not said:
                print(f"cloudrc teleop: {error}", file=sys.stderr, flush=True)
                said = True
            if bridge is not None:
                bridge.closed = str(error)
            time.sleep(LOCK_PERIOD)
            continue
        if journal.trouble:
            print(f"cloudrc teleop: {journal.trouble}", file=sys.stderr, flush=True)
        return journal
    return None


def _open_service(experiment: ResolvedExperiment, journal: Journal | None) -> MissionService:
    """Remember what the journal has; what is too old to be known is taken out of it."""
    from cloudrc.cloud.teleop.service import MissionService

    limit = experiment.criteria.contact_speed_max_mps
    if journal is None:
        return MissionService(limit)
    service = MissionService(limit, journal.append, journal.entries)
    known = [entry for entry in journal.entries if service.book.knows(entry)]
    if len(known) < len(journal.entries):
        journal.rewrite(known)
    return service


def _start(
    options: argparse.Namespace, experiment: ResolvedExperiment, service: MissionService
) -> bool:
    """Start the mission that the flags ask for, if any; say whether there is one."""
    import time

    from cloudrc import assembly
    from cloudrc.cloud.teleop.service_mission import Order

    if not (options.start or options.mission):
        return False
    criteria, mission, name = experiment.criteria, experiment.mission, experiment.name
    if options.mission:
        mission, name = _load(options.mission, experiment), Path(options.mission).stem
    plan = assembly.mission_plan(mission, criteria.time_limit_s, experiment.seed)
    service.create(Order(plan, name, contact=criteria.contact), time.monotonic_ns())
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


def _api_address(text: str) -> Address:
    """Read HOST:PORT; the port may be 0."""
    from cloudrc.cli.ends import address

    host, colon, port = text.rpartition(":")
    return (host, 0) if host and colon and port == "0" else address(text)
