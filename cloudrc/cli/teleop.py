"""`cloudrc teleop`: the process that flies missions; its API is where they come from.

The emergency stop past teleop's loop: one datagram to cloud, repeated where it is not taken.

The API of `cloudrc teleop`: its flags come in, a server goes out, with tokens and audit log.

Room for the journal to be shortened where it has filled its volume: a file that is given up.

What a start takes out of the journal is taken out by writing the rest anew beside it, for which a
full disk has no room; and to wait for the next start would be to wait for ever. So some room is
kept by a file, which is deleted then and made again once the old journal is gone. Names beside the
journal are its own, as that of its lock is; all this happens while the lock is held.
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
from cloudrc.cli.output import say
from cloudrc.cli.runtime import Address, address, open_exporter, process_arguments, warn_if_exposed

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
"""Between two tries [s]."""
REPEAT_LIMIT = 2.0
"""After the operator's word [s]: who has not had an answer by then asks again, and a cloud that
stands still for so long has a robot that holds."""


class Alarm:
    """Tells cloud to stop the rotors; may be called from any thread, and waits for nobody.

    A cloud that stands still lets eleven datagrams wait, and refuses what comes then. Teleop's loop
    would say it again, but may itself be waiting for its disk: so a thread says it until cloud has
    taken it, and goes.
    """

    def __init__(self, send: Callable[[], bool]) -> None:
        """Begin.

        Args:
            send: Sends it, if cloud takes it now; says whether it did. Must not block.
        """
        self._send = send
        self._lock = threading.Lock()
        self._until = 0.0
        self._repeats = False  # there is such a thread

    def __call__(self) -> None:
        """Send it, now or as soon as cloud takes it."""
        with self._lock:
            if self._send():
                self._until = 0.0  # once is enough
                return
            self._until = time.monotonic() + REPEAT_LIMIT
            if self._repeats:
                return
            try:
                threading.Thread(target=self._repeat, name="alarm", daemon=True).start()
            except RuntimeError:  # there can be no more threads: it is left to teleop's loop
                return
            self._repeats = True

    def _repeat(self) -> None:
        while self._repeats_after(REPEAT_PERIOD):
            pass

    def _repeats_after(self, period: float) -> bool:
        """Wait, then try again; say whether it has to be tried once more."""
        time.sleep(period)
        with self._lock:  # whoever asks meanwhile finds a thread that goes on, or none
            self._repeats = time.monotonic() < self._until and not self._send()
            return self._repeats


LOOPBACK = "127.0.0.1"
COUNT_PERIOD_NS = 1_000_000_000
"""Between two times that the API's counts become metrics [ns]."""


class ServedApi:
    """An API that answers; until it is opened only that teleop is not ready yet.

    Attributes:
        bridge: From its threads to teleop's loop.
    """

    def __init__(self, bridge: Bridge, server: ApiServer, audit: Audit) -> None:
        self.bridge, self._server, self._audit = bridge, server, audit
        self._service: MissionService | None = None
        self._counted_ns = 0

    def open(self, service: MissionService, alarm: Callable[[], object]) -> None:
        """Serve missions from now on.

        Args:
            service: Of them.
            alarm: Sends an emergency stop past the service; called from any thread.
        """
        self.bridge.alarm, self._service = alarm, service
        self.bridge.open(service)

    def counted(self) -> list[Counted]:
        """What was done with requests so far, once a second."""
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
        """Answer what is asked, and end."""
        self._server.stop()
        self._audit.close()


def serve_api(options: argparse.Namespace, experiment: ResolvedExperiment) -> ServedApi:
    """Answer from now on, if only that teleop is not ready yet."""
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
    audit = Audit(options.audit, complain)
    gate = Gate(create_app(bridge, surroundings), tokens, audit, complain=complain)
    server = ApiServer(gate, bridge, options.api)
    server.start()
    if options.api_file is not None:
        publish(options.api_file, json.dumps({"schemaVersion": 1, "url": server.url}) + "\n")
    return ServedApi(bridge, server, audit)


def complain(text: str) -> None:
    """Write a line into the process's log; from any thread."""
    say(f"cloudrc teleop: {text}", sys.stderr)


def api_address(text: str) -> Address | Path:
    """Read [HOST:]PORT, whose port may be 0, or unix:PATH."""
    if text.startswith("unix:") and len(text) > len("unix:"):
        return Path(text.removeprefix("unix:"))
    host, colon, port = text.rpartition(":")
    host = host if colon else LOOPBACK
    return (host, 0) if host and port == "0" else address(f"{host}:{port}")


RESERVE_SIZE = 2 << 20
"""Of the file [bytes].

What a start leaves are the 100 missions that have ended last, and 17 that have not. The paper's, of
seven waypoints, takes 3.8 kB, all of them 0.45 MB; here is room for 45 waypoints in each. The
chart's volume has 64 MiB, of which the audit log may take 16.
"""
FULL = (errno.ENOSPC, errno.EDQUOT)


def room(folder: Path) -> int:
    """How much a folder's volume has left for this user [bytes]."""
    volume = os.statvfs(folder)
    return volume.f_bavail * volume.f_frsize


def shorten(journal: Journal, known: Sequence[Entry], disk: Disk | None = None) -> str:
    """Leave in the journal what is known alone, also on a full disk; keep room for the next time.

    What the disk refuses stops nobody: the journal is then as before.

    Args:
        journal: Open.
        known: Those of its entries that are to stay.
        disk: Where it is; None for the machine's own.

    Returns:
        What is wrong and what to do about it; "" if nothing.
    """
    reserve = Reserve(journal.path, disk)
    try:
        if len(known) < len(journal.entries):
            _rewrite(journal, known, reserve)
    except OSError as error:  # the reserve stays away: there is more need of its room now
        return (
            f"{journal.path}: cannot be shortened to the missions still known: {error.strerror}; "
            "once it is full no mission can start: free or mend its volume, then restart teleop"
        )
    try:
        reserve.make()
    except OSError as error:
        complain(
            f"{reserve.path}: {error.strerror}: without it a restart cannot shorten a journal that "
            "has filled its volume; free or mend that"
        )
    return ""


def _rewrite(journal: Journal, known: Sequence[Entry], reserve: Reserve) -> None:
    """Write the journal anew, if need be in the room of the reserve."""
    try:
        journal.rewrite(known)
    except OSError as error:
        if error.errno not in FULL or not reserve.give_up():
            raise
        journal.rewrite(known)


class Reserve:
    """A file beside the journal that holds nothing but room.

    Attributes:
        path: Of it.
    """

    def __init__(self, journal: Path, disk: Disk | None = None) -> None:
        """Touch nothing yet.

        Args:
            journal: Path of the journal.
            disk: Where it is; None for the machine's own.
        """
        from cloudrc.teleop.journal import Disk

        self.path, self._disk = journal.with_name(f"{journal.name}.reserve"), disk or Disk()

    def give_up(self) -> bool:
        """Delete it; say whether there was one.

        Raises:
            OSError: If the disk refuses.
        """
        if self._size() is None:
            return False
        self._disk.remove(self.path)
        self._disk.sync_folder(self.path.parent)  # some disks give room back with that alone
        return True

    def make(self) -> None:
        """Make it, unless it is there and whole.

        Raises:
            OSError: If the disk refuses, or has no more room than entries need; there is none then.
        """
        if self._size() == RESERVE_SIZE:
            return
        self._disk.remove(self.path)  # one that a crash has left, or whatever a link leads to
        if room(self.path.parent) < 2 * RESERVE_SIZE:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        file = self._disk.open(self.path, new=True)
        try:
            # Not zeros, nor a hole: a disk that compresses would keep no room for those.
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
        """Its length [bytes]; None if there is none."""
        try:
            return self.path.lstat().st_size
        except OSError:
            return None


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
