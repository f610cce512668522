"""Run `cloudrc teleop`: the process that flies missions, with its API and its journal.

An emergency stop bypasses teleop's loop, which may be waiting for its disk: a thread repeats one
datagram until cloud accepts it.

A start removes old missions from the journal: it writes the others to a new file beside it. A full
disk has no room for that, so a reserve file keeps some. It is deleted when the room is needed, and
made again once the old journal is gone. All this happens while teleop holds the journal's lock.
"""

from __future__ import annotations

import argparse
import errno
import os
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cloudrc.cli.extras import require
from cloudrc.cli.output import print_line
from cloudrc.cli.runtime import (
    Address,
    open_exporter,
    process_arguments,
    read_address,
    warn_if_exposed,
)

if TYPE_CHECKING:
    from cloudrc.config.load import ResolvedExperiment
    from cloudrc.drivers.exporter import Exporter
    from cloudrc.drivers.teleop import Calls
    from cloudrc.records import Counted
    from cloudrc.teleop.auth import Audit
    from cloudrc.teleop.bridge import Bridge
    from cloudrc.teleop.journal import Disk, Entry, Journal
    from cloudrc.teleop.server import ApiServer
    from cloudrc.teleop.service import MissionService


REPEAT_PERIOD = 0.02
"""Pause between two attempts to send an emergency stop [s]."""
REPEAT_LIMIT = 2.0
"""Time for which an emergency stop is repeated [s]. If cloud is blocked for that long, the robot
holds."""


class EmergencyStopSender:
    """Send an emergency stop to cloud, from any thread, without blocking.

    The socket of a blocked cloud queues eleven datagrams and refuses more. Then a thread repeats
    the stop until cloud accepts it.
    """

    def __init__(self, send: Callable[[], bool]) -> None:
        """Store how to send.

        Args:
            send: Sends the stop once; returns whether cloud accepted it. Must not block.
        """
        self._send = send
        self._lock = threading.Lock()
        self._deadline = 0.0
        self._repeating = False  # whether the thread runs

    def __call__(self) -> None:
        """Send the stop, now or as soon as cloud accepts it."""
        with self._lock:
            if self._send():
                self._deadline = 0.0  # ends the thread
                return
            self._deadline = time.monotonic() + REPEAT_LIMIT
            if self._repeating:
                return
            try:
                threading.Thread(target=self._repeat, name="alarm", daemon=True).start()
            except RuntimeError:  # no more threads: teleop's loop repeats the stop
                return
            self._repeating = True

    def _repeat(self) -> None:
        while self._try_again(REPEAT_PERIOD):
            pass

    def _try_again(self, period: float) -> bool:
        """Wait, then send again; return whether another attempt is needed."""
        time.sleep(period)
        with self._lock:  # `_repeating` is true only while this thread will try again
            self._repeating = time.monotonic() < self._deadline and not self._send()
            return self._repeating


LOOPBACK = "127.0.0.1"
COUNT_PERIOD_NS = 1_000_000_000
"""Time between two updates of the metrics from the API's counts [ns]."""


class ServedApi:
    """Serve the API; until `open` it answers that teleop is not ready.

    Attributes:
        bridge: Passes calls from the API's threads to teleop's loop.
    """

    def __init__(self, bridge: Bridge, server: ApiServer, audit: Audit) -> None:
        self.bridge, self._server, self._audit = bridge, server, audit
        self._service: MissionService | None = None
        self._counted_ns = 0

    def open(self, service: MissionService, alarm: Callable[[], object]) -> None:
        """Start to serve missions.

        Args:
            service: The service that flies them.
            alarm: Sends an emergency stop directly to cloud; called from any thread.
        """
        self.bridge.alarm, self._service = alarm, service
        self.bridge.open(service)

    def counted(self) -> list[Counted]:
        """Return the counts of requests once a second, else an empty list."""
        import time

        from cloudrc.records import Counted

        now_ns = time.monotonic_ns()
        if now_ns - self._counted_ns < COUNT_PERIOD_NS:
            return []
        self._counted_ns = now_ns
        counts = {**self._server.counts, "audit_dropped": self._audit.dropped}
        if self._service is not None:
            counts["events_dropped"] = self._service.book.dropped
        return [Counted(now_ns, "teleop", f"api_{name}", n) for name, n in sorted(counts.items())]

    def stop(self) -> None:
        """Finish the open requests and stop."""
        self._server.stop()
        self._audit.close()


def serve_api(options: argparse.Namespace, experiment: ResolvedExperiment) -> ServedApi:
    """Start the API; it answers that teleop is not ready until it is opened."""
    import json
    from functools import partial

    from cloudrc import assembly
    from cloudrc.geometry.scene import load_scene
    from cloudrc.link.state import publish
    from cloudrc.teleop.api import Surroundings, create_app
    from cloudrc.teleop.auth import Audit, Tokens
    from cloudrc.teleop.bridge import Bridge
    from cloudrc.teleop.server import ApiServer, Gate

    if not isinstance(options.api, Path):
        warn_if_exposed(options.api)
    criteria, bridge = experiment.criteria, Bridge()
    scene = load_scene(experiment.world.scene)
    plan = partial(assembly.mission_plan, speed_max=experiment.guard.speed_max_mps)
    surroundings = Surroundings(scene, criteria.time_limit_s, criteria.contact, plan)
    tokens = Tokens(options.tokens) if options.tokens else None
    audit = Audit(options.audit, log_line)
    gate = Gate(create_app(bridge, surroundings), tokens, audit, complain=log_line)
    server = ApiServer(gate, bridge, options.api)
    server.start()
    if options.api_file is not None:
        publish(options.api_file, json.dumps({"schemaVersion": 1, "url": server.url}) + "\n")
    return ServedApi(bridge, server, audit)


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


RESERVE_SIZE = 2 << 20
"""Size of the reserve file [bytes].

A start keeps at most the last 100 missions that have ended and 17 others. The paper's mission with
seven waypoints takes 3.8 kB, 117 of them 0.45 MB; the reserve suffices for 45 waypoints in each.
The chart's volume has 64 MiB, of which the audit log may take 16.
"""
FULL = (errno.ENOSPC, errno.EDQUOT)
"""Errors that mean a full disk."""


def free_space(folder: Path) -> int:
    """Return the free space of a folder's volume for this user [bytes]."""
    volume = os.statvfs(folder)
    return volume.f_bavail * volume.f_frsize


def shorten_journal(journal: Journal, known: Sequence[Entry], disk: Disk | None = None) -> str:
    """Reduce the journal to its known entries, also on a full disk, and renew the reserve.

    If the disk refuses, teleop continues with the old journal.

    Args:
        journal: The open journal.
        known: Entries to keep.
        disk: Disk of the journal; None for the real one.

    Returns:
        The problem and its remedy; "" without a problem.
    """
    reserve = Reserve(journal.path, disk)
    try:
        if len(known) < len(journal.entries):
            _rewrite(journal, known, reserve)
    except OSError as error:  # do not renew the reserve: the journal needs its room now
        return (
            f"{journal.path}: cannot be shortened to the missions still known: {error.strerror}; "
            "once it is full no mission can start: free space or repair the volume, then restart "
            "teleop"
        )
    try:
        reserve.make()
    except OSError as error:
        log_line(
            f"{reserve.path}: {error.strerror}: without it a restart cannot shorten a journal that "
            "has filled its volume; free space or repair the volume"
        )
    return ""


def _rewrite(journal: Journal, known: Sequence[Entry], reserve: Reserve) -> None:
    """Rewrite the journal; on a full disk delete the reserve first."""
    try:
        journal.rewrite(known)
    except OSError as error:
        if error.errno not in FULL or not reserve.give_up():
            raise
        journal.rewrite(known)


class Reserve:
    """Manage the reserve: a file beside the journal that only occupies space.

    Attributes:
        path: Path of the reserve.
    """

    def __init__(self, journal: Path, disk: Disk | None = None) -> None:
        """Store the path; touch no file.

        Args:
            journal: Path of the journal.
            disk: Disk of the journal; None for the real one.
        """
        from cloudrc.teleop.journal import Disk

        self.path, self._disk = journal.with_name(f"{journal.name}.reserve"), disk or Disk()

    def give_up(self) -> bool:
        """Delete the reserve; return whether it existed.

        Raises:
            OSError: If the disk refuses.
        """
        if self._size() is None:
            return False
        self._disk.remove(self.path)
        self._disk.sync_folder(self.path.parent)  # some disks free the space only then
        return True

    def make(self) -> None:
        """Make the reserve, unless it exists in full size.

        Raises:
            OSError: If the disk refuses or has too little space; there is no reserve then.
        """
        if self._size() == RESERVE_SIZE:
            return
        self._disk.remove(self.path)  # the rest of a crash, or a symbolic link
        if free_space(self.path.parent) < 2 * RESERVE_SIZE:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        file = self._disk.open(self.path, new=True)
        try:
            # Random bytes: a file system that compresses would keep no space for zeros or holes.
            left = memoryview(os.urandom(RESERVE_SIZE))
            while left:
                left = left[self._disk.write(file, bytes(left)) :]
            self._disk.sync(file)
        except OSError:
            with suppress(OSError):
                self._disk.remove(self.path)
            raise
        finally:
            self._disk.close(file)

    def _size(self) -> int | None:
        """Return the size of the reserve [bytes]; None without one."""
        try:
            return self.path.lstat().st_size
        except OSError:
            return None


EPILOG = """\
teleop talks to 'cloudrc cloud --teleop DIR' through two sockets in DIR. With
--start or --mission it ends after that mission; otherwise on SIGTERM, on Ctrl-C
and when its parent process has ended. A flying robot then holds; a new teleop
with the same journal resumes the mission.

/openapi.json describes the API. The API asks for a token, except on a socket
file, which only its owner can open. To make a token:
openssl rand -hex 32 > DIR/operator. The token in DIR/reader may only read."""
LOCK_PERIOD = 0.2
"""Pause between two attempts to lock the journal [s]."""
PAUSE_LIMIT_NS = 500_000_000
"""Longest wait for the robot to hold before teleop ends [ns]."""
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
    """Run teleop until its mission has ended or it is told to stop."""
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
                return 0  # stopped while another teleop held the journal
        service = _open_service(experiment, journal)
        single_mission = _start(options, experiment, service)
        ending = _Ending(service, stop)
        over = lambda: ending() or (single_mission and service.over)  # noqa: E731
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
    """Decide when teleop may end: first pause the mission, then wait until the robot holds."""

    def __init__(self, service: MissionService, asked: Callable[[], bool]) -> None:
        self._service, self._stop_asked = service, asked
        self._since_ns: int | None = None

    def __call__(self) -> bool:
        import time

        if not self._stop_asked():
            return False
        if self._since_ns is None:
            self._service.pause(time.monotonic_ns())
            self._since_ns = (
                time.monotonic_ns()
            )  # again: pausing writes to the disk, which may take long
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
        served.open(service, EmergencyStopSender(lambda: peer.send(wire.encode(wire.ALARM))))
        calls, stops = served.bridge.take, served.bridge.take_urgent
    feed.ready()

    def publish(records: list[Any]) -> None:
        feed.tell(record for record in records if isinstance(record, Fault))  # cloud has events
        if exporter is not None:
            exporter.see(records)

    def update_and_check() -> bool:
        if exporter is not None:
            exporter.ready(service.sight.seen is not None)
            if served is not None:
                exporter.see(served.counted())
        return stop()

    if trouble:
        publish([Fault(0, "journal", trouble)])
    serve_teleop(
        service,
        peer,
        wire.encode,
        wire.decode,
        calls=calls,
        stops=stops,
        tell=publish,
        stop=feed.alive_while(update_and_check),
    )


def _open_journal(path: Path, stop: Callable[[], bool], bridge: Bridge | None) -> Journal | None:
    """Open the journal once no other teleop holds it; None if stopped before."""
    import time

    from cloudrc.teleop.journal import Journal, JournalLockedError

    reported = False
    while not stop():
        try:
            journal = Journal(path)
        except JournalLockedError as error:
            if not reported:
                print(f"cloudrc teleop: {error}", file=sys.stderr, flush=True)
                reported = True
            if bridge is not None:
                bridge.close(str(error))
            time.sleep(LOCK_PERIOD)
            continue
        if journal.trouble:
            print(f"cloudrc teleop: {journal.trouble}", file=sys.stderr, flush=True)
        return journal
    return None


def _open_service(experiment: ResolvedExperiment, journal: Journal | None) -> MissionService:
    """Make the service from the journal, and remove missions that are too old from it."""
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
            f"--journal {journal.path}: this version cannot read its entries; was it written by "
            "another version? Move it away, or name another file"
        ) from error
    known = [entry for entry in journal.entries if service.book.knows(entry)]
    if trouble := shorten_journal(journal, known):
        log_line(trouble)
        journal.trouble = "; ".join(filter(None, (journal.trouble, trouble)))
    return service


def _start(
    options: argparse.Namespace, experiment: ResolvedExperiment, service: MissionService
) -> bool:
    """Start the mission of the command line, if any; return whether there is one."""
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
        return True  # the previous process started it with the same options: it resumes
    try:
        service.create(Order(plan, name, contact=criteria.contact), time.monotonic_ns())
    except ConflictError as error:
        if not options.api:
            raise
        print(f"cloudrc teleop: {error}", file=sys.stderr, flush=True)
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
