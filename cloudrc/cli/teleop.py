"""`cloudrc teleop`: the process that flies missions; its API is where they come from."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cloudrc.cli.ends import open_exporter, process_arguments
from cloudrc.cli.extras import require
from cloudrc.cli.teleop_alarm import Alarm
from cloudrc.cli.teleop_api import ServedApi, api_address, complain, serve_api
from cloudrc.cli.teleop_reserve import shorten

if TYPE_CHECKING:
    from cloudrc.config.load import ResolvedExperiment
    from cloudrc.drivers.exporter import Exporter
    from cloudrc.drivers.teleop import Calls
    from cloudrc.teleop.bridge import Bridge
    from cloudrc.teleop.journal import Journal
    from cloudrc.teleop.service import MissionService

EPILOG = """\
It talks to 'cloudrc cloud --teleop DIR' through two sockets in DIR. With
--start or --mission it ends once that is flown; else on SIGTERM, on Ctrl-C,
and when the process that started it is gone; what flies then holds, and a
successor with the same journal goes on. The API describes itself:
/openapi.json. It asks for a token, except on a socket file, which only its
owner can open. A token: openssl rand -hex 32 > DIR/operator; one in DIR/reader
may look, not command."""
LOCK_PERIOD = 0.2
"""Between two tries to get the journal [s]."""
PAUSE_LIMIT_NS = 500_000_000
"""For the robot to be seen to hold before teleop ends [ns]."""
SALT_SIZE = 16


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
        help="serve the API here: [HOST:]PORT, HOST being 127.0.0.1 unless you say, port 0: any; "
        "or unix:PATH, for you alone (default: not at all)",
    )
    parser.add_argument(
        "--tokens", type=Path, metavar="DIR", help="token files, 'operator' and 'reader'"
    )
    parser.add_argument(
        "--audit", type=Path, metavar="FILE", help="write here who commanded what (JSON lines)"
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
    from cloudrc.config.load import fingerprint, read_experiment
    from cloudrc.drivers.process import StopSignal
    from cloudrc.records import Counted

    if options.api:
        require("the API of teleop", ("api",))
    stop, exporter = StopSignal(), open_exporter(options, "teleop")
    experiment = read_experiment(str(options.config))
    if exporter is not None:
        exporter.runs(fingerprint(experiment))
    served = serve_api(options, experiment) if options.api else None
    journal = None
    try:
        if options.journal:
            journal = _open_journal(options.journal, stop, served.bridge if served else None)
            if journal is None:
                return 0  # stopped while another one had it
        service = _open_service(experiment, journal)
        ends = _start(options, experiment, service)
        ending = _Ending(service, stop)
        over = lambda: ending() or (ends and service.over)  # noqa: E731
        if exporter is not None and journal is not None and journal.repaired:
            exporter.see([Counted(0, "teleop", "journal_repaired", 1)])
        _fly(options, service, served, exporter, over, journal.trouble if journal else "")
    finally:
        if served is not None:
            served.stop()
        if journal is not None:
            journal.close()
    return 0


class _Ending:
    """Lets teleop end: what flies is paused first, and the robot is given the time to hold."""

    def __init__(self, service: MissionService, asked: Callable[[], bool]) -> None:
        self._service, self._asked = service, asked
        self._since_ns: int | None = None

    def __call__(self) -> bool:
        import time

        if not self._asked():
            return False
        if self._since_ns is None:
            self._service.pause(time.monotonic_ns())
            self._since_ns = time.monotonic_ns()  # its disk may have taken long
        return self._service.settled or time.monotonic_ns() - self._since_ns > PAUSE_LIMIT_NS


def _fly(
    options: argparse.Namespace,
    service: MissionService,
    served: ServedApi | None,
    exporter: Exporter | None,
    stop: Callable[[], bool],
    trouble: str,
) -> None:
    """Run the service until `stop()`."""
    from cloudrc.drivers.feed import Feed
    from cloudrc.drivers.teleop import UnixPeer, serve_teleop
    from cloudrc.records import Fault
    from cloudrc.teleop import wire

    feed = Feed.on_stdout(watched=options.feed)
    peer = UnixPeer(options.socket / "teleop.sock", options.socket / "cloud.sock")
    calls: Calls = list
    stops: Calls = list
    if served is not None:
        served.open(service, Alarm(lambda: peer.send(wire.encode(wire.ALARM))))
        calls, stops = served.bridge.take, served.bridge.take_urgent
    feed.ready()

    def tell(told: list[Any]) -> None:
        feed.tell(record for record in told if isinstance(record, Fault))  # cloud tells events
        if exporter is not None:
            exporter.see(told)

    def ask() -> bool:
        if exporter is not None:
            exporter.ready(service.sight.seen is not None)
            if served is not None:
                exporter.see(served.counted())
        return stop()

    if trouble:
        tell([Fault(0, "journal", trouble)])
    serve_teleop(
        service, peer, wire.encode, wire.decode, calls=calls, stops=stops, tell=tell, stop=ask
    )


def _open_journal(path: Path, stop: Callable[[], bool], bridge: Bridge | None) -> Journal | None:
    """Wait for the journal as long as another teleop holds it; None if told to stop."""
    import time

    from cloudrc.teleop.journal import Journal, JournalLockedError

    said = False
    while not stop():
        try:
            journal = Journal(path)
        except JournalLockedError as error:
            if not said:
                print(f"cloudrc teleop: {error}", file=sys.stderr, flush=True)
                said = True
            if bridge is not None:
                bridge.close(str(error))
            time.sleep(LOCK_PERIOD)
            continue
        if journal.trouble:
            print(f"cloudrc teleop: {journal.trouble}", file=sys.stderr, flush=True)
        return journal
    return None


def _open_service(experiment: ResolvedExperiment, journal: Journal | None) -> MissionService:
    """Remember what the journal has; what is too old to be known is taken out of it."""
    import os

    from cloudrc.errors import BadInputError
    from cloudrc.teleop.service import MissionService

    limit, salt = experiment.criteria.contact_speed_max_mps, os.urandom(SALT_SIZE)
    if journal is None:
        return MissionService(limit, salt=salt)
    try:
        service = MissionService(limit, journal.append, journal.entries, salt=salt)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise BadInputError(
            f"--journal {journal.path}: it holds whole entries that this version cannot read: was "
            "it written by another one? Move it away, or name another file"
        ) from error
    known = [entry for entry in journal.entries if service.book.knows(entry)]
    if trouble := shorten(journal, known):
        complain(trouble)
        journal.trouble = "; ".join(filter(None, (journal.trouble, trouble)))
    return service


def _start(
    options: argparse.Namespace, experiment: ResolvedExperiment, service: MissionService
) -> bool:
    """Start the mission that the flags ask for, if any; say whether there is one."""
    import time

    from cloudrc import assembly
    from cloudrc.teleop.store import ConflictError, Order

    if not (options.start or options.mission):
        return False
    criteria, mission, name = experiment.criteria, experiment.mission, experiment.name
    if options.mission:
        mission, name = _load(options.mission, experiment), Path(options.mission).stem
    plan = assembly.mission_plan(mission, criteria.time_limit_s, experiment.seed)
    if any(each.order.plan == plan for each in service.book.open()):
        return True  # of the process before this one, which had the same flags: it goes on
    try:
        service.create(Order(plan, name, contact=criteria.contact), time.monotonic_ns())
    except ConflictError as error:
        if not options.api:
            raise
        print(f"cloudrc teleop: {error}", file=sys.stderr, flush=True)
        return False  # whoever acknowledges a stop, or cancels what is in the way, needs the API
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
