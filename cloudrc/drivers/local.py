"""Local mode: relay, world, teleop and cloud as processes on this machine, and who watches them.

The supervisor starts them in the order in which they need each other, reads what they tell, and
ends all of them when teleop ends because the mission is over, when another one dies, or when the
user interrupts.

Flights under way on this machine: each says where it is, so that its operator need not know.

A small file per flight, in a folder that is this user's alone: what stands in it is believed, which
a run's folder, that may have come from anywhere, is not. It is locked for as long as the flight
lasts: what a killed one has left behind is known by that, and taken away.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import secrets
import selectors
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from cloudrc.drivers.feed import READY, from_line
from cloudrc.drivers.machine import interpreter
from cloudrc.drivers.process import PARENT
from cloudrc.drivers.realtime import free_ports
from cloudrc.errors import InvalidRunError, TimedOutError, in_one_line
from cloudrc.records import Fault, Record
from cloudrc.tunnel.keys import KEY_SIZE, Key, KeySet, write

FOLDER = Path("cloudrc", "flights")
PRIVATE = 0o700


def places() -> list[Path]:
    """Where such files may be; a login has both places, a job of cron perhaps only the second.

    Source: XDG Base Directory Specification.
    """
    roots = []
    if runtime := os.environ.get("XDG_RUNTIME_DIR"):
        roots.append(Path(runtime))
    with contextlib.suppress(RuntimeError):  # a user without a home
        roots.append(Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"))
    return [root / FOLDER for root in dict.fromkeys(roots)]


@contextlib.contextmanager
def announced(run: Path, api: str = "") -> Iterator[bool]:
    """Tell of the flight of a run's folder for as long as the block lasts; say whether it is told.

    Where no such file can be written it flies all the same.

    Args:
        run: Its folder.
        api: Address of its operator's API; "" without one.
    """
    path, lock = None, -1
    for place in places():
        with contextlib.suppress(OSError):
            path, lock = _write(place, run, api)
            break
    try:
        yield path is not None
    finally:
        if path is not None:
            with contextlib.suppress(OSError):
                path.unlink()
            os.close(lock)


def under_way() -> dict[Path, str]:
    """Folders of the runs of this user that fly now, the newest first, with their APIs' addresses.

    A run without an API has "" there.
    """
    found = []
    for place in places():
        if not _is_ours(place):
            continue
        for path in place.glob("*.json"):
            with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
                begun = path.stat().st_mtime_ns
                if _is_ours(path) and (flight := _read(path)) is not None:
                    found.append((begun, *flight))
    return {run: api for _, run, api in sorted(found, reverse=True)}


def _write(place: Path, run: Path, api: str) -> tuple[Path, int]:
    """Make the file, locked from the moment that it has its name."""
    place.mkdir(mode=PRIVATE, parents=True, exist_ok=True)
    if not _is_ours(place):
        raise PermissionError(f"{place} is not this user's alone")
    path = place / f"{os.getpid()}-{secrets.token_hex(4)}.json"
    new = path.with_suffix(".new")
    lock = os.open(new, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)
        told = {"schemaVersion": 1, "run": str(run.resolve()), "api": api}
        os.write(lock, json.dumps(told).encode() + b"\n")
        new.rename(path)
    except OSError:
        os.close(lock)
        new.unlink(missing_ok=True)
        raise
    return path, lock


def _read(path: Path) -> tuple[Path, str] | None:
    """Read where a flight and its API are; None if it is over: then its file is taken away."""
    with path.open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            told = json.loads(file.read())
            return Path(told["run"]), str(told.get("api", ""))
    path.unlink(missing_ok=True)
    return None


def _is_ours(place: Path) -> bool:
    """Say whether it is this user's, and nobody else can look into it or write to it."""
    try:
        state = place.stat()
    except OSError:
        return False
    return state.st_uid == os.getuid() and not state.st_mode & 0o077


START_LIMIT = 60.0
"""For a process to become ready [s]; a cold start reads some 100 MB from disk."""
STOP_LIMIT = 1.5
"""For a process to end by itself once it is asked to [s]."""
TELL_ALWAYS = ("world", "cloud")
SILENCE_LIMIT = 5.0
"""A process that has told something and then nothing for so long hangs [s]."""
LOOPBACK = "127.0.0.1"
API_FILE = "api.json"
"""In the folder of a run that flies: where its operator's API is, for other programs. Ours take
that from the user's own `flights`: a folder may have come from anywhere, and say anything."""
AUDIT_FILE = "audit.jsonl"
"""Likewise, and afterwards, too: who commanded what over it, if anybody did."""
UNANNOUNCED = (
    "no folder for the file by which 'cloudrc mission' finds this run (XDG_STATE_HOME); give it "
    "--api {}"
)
LINK_FOLDER = "link"
"""Likewise: where its relay tells what it does, and is told to do otherwise."""


class ProcessDiedError(InvalidRunError):
    """One of the processes ended before the mission was over."""


@dataclass
class Child:
    """One of the processes.

    Attributes:
        name: Of its command.
        process: Running or ended.
        log: Gets what it writes to standard error.
        unread: The beginning of a line of its feed whose end has not come yet.
        heard: When it last told something [s], monotonic clock; None before the first time.
        ready: Whether it has said so.
        garbled: Whether it has told what is no record.
    """

    name: str
    process: subprocess.Popen[bytes]
    log: Path
    unread: bytes = field(default=b"")
    heard: float | None = field(default=None)
    ready: bool = field(default=False)
    garbled: bool = field(default=False)

    def last_words(self) -> str:
        """The last line that it wrote to its log, if any."""
        lines = self.log.read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else "it left no message"


class LocalRun:
    """The four processes of one run."""

    def __init__(
        self, folder: Path, see: Callable[[list[Record]], None], *, api: bool = True
    ) -> None:
        """Prepare; nothing is started yet.

        Args:
            folder: Of the run; has config.yaml, gets world.mcap, cloud.mcap and four logs.
            see: Gets the records that the processes tell about.
            api: Whether the operator gets an API while it flies; it is announced, and api.json
                says where.
        """
        self._folder, self._see, self._api = folder, see, api
        self._key = folder  # until there is one
        self._children: list[Child] = []
        self._selector = selectors.DefaultSelector()

    def fly(self, limit: float) -> None:
        """Fly until teleop says that the mission is over.

        Args:
            limit: Longest duration [s].

        Raises:
            ProcessDiedError: If a process ends too early; it is named.
            TimedOutError: If the limit is reached, or one falls silent; it is named.
            KeyboardInterrupt: If the user interrupts. The processes have ended in every case.
        """
        # A socket's path is short; that of the run's folder need not be.
        # Nobody else may look into this one, which holds the key of this run alone, too.
        with (
            tempfile.TemporaryDirectory(prefix="cloudrc-") as sockets,
            announced(self._folder, url := self._url(sockets)) as told,
        ):
            if url and not told:
                self._see([Fault(0, "unannounced", UNANNOUNCED.format(url))])
            self._key = Path(sockets) / "key"
            self._key.touch(0o600)
            self._key.write_text(write(KeySet(Key(os.urandom(KEY_SIZE)))), encoding="ascii")
            self._fly(limit, sockets)

    def _fly(self, limit: float, sockets: str) -> None:
        world, from_world, from_cloud, cloud = _free_addresses(4)
        try:
            self._start(
                "relay",
                f"--world-side={from_world}",
                f"--cloud-side={from_cloud}",
                f"--world={world}",
                f"--cloud={cloud}",
                f"--link={self._folder / LINK_FOLDER}",
                "--fifo",
            )
            self._start_end("world", world, from_world)
            self._start_teleop(sockets)
            self._wait_until_ready()
            self._start_end("cloud", cloud, from_cloud, f"--teleop={sockets}")
            self._watch(limit)
        finally:
            self._stop()
            (self._folder / API_FILE).unlink(missing_ok=True)
            shutil.rmtree(self._folder / LINK_FOLDER, ignore_errors=True)

    def _start_end(self, name: str, listen: str, peer: str, *options: str) -> None:
        record = self._folder / f"{name}.mcap"
        link = self._folder / LINK_FOLDER / ("uplink.json" if name == "world" else "downlink.json")
        ways = (f"--listen={listen}", f"--peer={peer}", f"--link={link}", f"--key={self._key}")
        self._start(name, *ways, f"--record={record}", *options)

    def _url(self, sockets: str) -> str:
        """Where the operator's API is, below the folder of the sockets; "" without one."""
        return f"unix:{sockets}/api.sock" if self._api else ""

    def _start_teleop(self, sockets: str) -> None:
        api: list[str] = []
        if self._api:  # a socket file that this user alone can open: no token is needed
            api = [
                f"--api={self._url(sockets)}",
                f"--api-file={self._folder / API_FILE}",
                f"--audit={self._folder / AUDIT_FILE}",
            ]
        self._start("teleop", f"--socket={sockets}", "--start", *api)

    def _start(self, name: str, *options: str) -> None:
        log = self._folder / f"{name}.log"
        config = f"--config={self._folder / 'config.yaml'}"
        command = interpreter("-m", "cloudrc", name, config, "--feed", *options)
        with log.open("wb") as errors:
            process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=errors,
                env={**os.environ, PARENT: str(os.getpid())},
                start_new_session=True,  # Ctrl-C reaches the supervisor alone, which ends them
            )
        child = Child(name, process, log)
        assert process.stdout is not None
        os.set_blocking(process.stdout.fileno(), False)
        self._selector.register(process.stdout, selectors.EVENT_READ, child)
        self._children.append(child)

    def _wait_until_ready(self) -> None:
        until = time.monotonic() + START_LIMIT
        while waiting := [child.name for child in self._children if not child.ready]:
            if time.monotonic() > until:
                raise TimedOutError(f"{' and '.join(waiting)}: not ready within {START_LIMIT:g} s")
            self._listen()
            self._check_alive()

    def _watch(self, limit: float) -> None:
        until = time.monotonic() + limit
        teleop = next(child for child in self._children if child.name == "teleop")
        while teleop.process.poll() is None:
            if time.monotonic() > until:
                raise TimedOutError(f"the flight was ended after {limit:g} s, its limit")
            self._see(self._listen())
            self._check_alive()
            self._check_awake()
        self._check_alive()
        self._see(self._listen())

    def _listen(self) -> list[Record]:
        """What the processes have told since the last call; waits 50 ms at most."""
        told: list[Record] = []
        for key, _ in self._selector.select(0.05):
            child: Child = key.data
            data = os.read(key.fd, 65_536)
            if not data:
                self._selector.unregister(key.fileobj)
            *lines, child.unread = (child.unread + data).split(b"\n")
            for line in lines:
                if line == READY.encode():
                    child.ready = True
                else:
                    told += _told(child, line)
                    if child.name in TELL_ALWAYS:
                        child.heard = time.monotonic()
        return told

    def _check_awake(self) -> None:
        now = time.monotonic()
        for child in self._children:
            if child.heard is not None and now - child.heard > SILENCE_LIMIT:
                raise TimedOutError(
                    f"the {child.name} process has been silent for {SILENCE_LIMIT:g} s and was "
                    f"ended; see {child.log}"
                )

    def _check_alive(self) -> None:
        for child in self._children:
            code = child.process.poll()
            if code is None or (child.name == "teleop" and code == 0):
                continue
            how = f"signal {-code}" if code < 0 else f"exit code {code}"
            raise ProcessDiedError(
                f"the {child.name} process died in flight ({how}): {child.last_words()}; "
                f"see {child.log}"
            )

    def _stop(self) -> None:
        """End what still runs: politely, then for good."""
        for child in self._children:
            child.process.terminate()
        until = time.monotonic() + STOP_LIMIT
        for child in self._children:
            try:
                child.process.wait(max(0.0, until - time.monotonic()))
            except subprocess.TimeoutExpired:
                child.process.kill()
                child.process.wait()
        self._selector.close()
        for child in self._children:
            if child.process.stdout is not None:
                child.process.stdout.close()


def _told(child: Child, line: bytes) -> list[Record]:
    """Read a line of a feed; one that is no record is said once, and ends no flight."""
    try:
        return [from_line(line.decode())]
    except ValueError as error:
        if child.garbled:
            return []
        child.garbled = True
        what = in_one_line(str(error))[:120]
        return [Fault(0, "feed", f"of the {child.name} process a line was left out: {what}")]


def _free_addresses(count: int) -> list[str]:
    """UDP addresses on this machine that nobody uses now."""
    return [f"{LOOPBACK}:{port}" for port in free_ports(count)]
