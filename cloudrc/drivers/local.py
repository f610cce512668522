"""Run relay, world, teleop and cloud as processes on this machine and supervise them.

The supervisor starts the processes in the order of their dependencies and reads their feeds. It
ends all processes when teleop ends after the mission, when another process dies, or when the user
interrupts.

Each flight has a small file, the flight file, which names the folder of the run and the address of
the operator's API. The flight file lies in a folder that only this user can write, so other
programs may trust the file. They cannot trust a run's folder, which may come from elsewhere. The
flight file is locked during the flight. An unlocked file is from a killed flight, and is removed.
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
from cloudrc.drivers.machine import Deadline, interpreter
from cloudrc.drivers.process import PARENT
from cloudrc.drivers.realtime import free_ports
from cloudrc.drivers.teleop import PATH_MAX
from cloudrc.errors import BadInputError, InvalidRunError, TimedOutError, to_one_line
from cloudrc.records import Fault, Record
from cloudrc.tunnel.keys import KEY_SIZE, Key, KeySet, write

FOLDER = Path("cloudrc", "flights")
PRIVATE = 0o700


def places() -> list[Path]:
    """List the folders for flight files; a login has two, a cron job perhaps only the second.

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
    """Announce a flight by a flight file while the block runs; yield whether the file was written.

    A flight also runs without the file.

    Args:
        run: Folder of the run.
        api: Address of the operator's API; "" without an API.
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
    """Find this user's current flights.

    Returns:
        Folder of the run -> address of the operator's API ("" without an API), newest first.
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
    """Create the flight file, and lock it before it gets its final name."""
    place.mkdir(mode=PRIVATE, parents=True, exist_ok=True)
    if not _is_ours(place):
        raise PermissionError(f"other users can access {place}")
    path = place / f"{os.getpid()}-{secrets.token_hex(4)}.json"
    new = path.with_suffix(".new")
    lock = os.open(new, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)
        flight = {"schemaVersion": 1, "run": str(run.resolve()), "api": api}
        os.write(lock, json.dumps(flight).encode() + b"\n")
        new.rename(path)
    except OSError:
        os.close(lock)
        new.unlink(missing_ok=True)
        raise
    return path, lock


def _read(path: Path) -> tuple[Path, str] | None:
    """Read folder and API address from a flight file; delete a file whose flight is over."""
    with path.open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            flight = json.loads(file.read())
            return Path(flight["run"]), str(flight.get("api", ""))
    path.unlink(missing_ok=True)
    return None


def _is_ours(place: Path) -> bool:
    """Check that this user owns a path, and that nobody else can read or write it."""
    try:
        state = place.stat()
    except OSError:
        return False
    return state.st_uid == os.getuid() and not state.st_mode & 0o077


START_LIMIT = 60.0
"""Time limit for a process to become ready [s]; a cold start reads some 100 MB from disk."""
STOP_LIMIT = 1.5
"""Time limit for a process to end after SIGTERM [s]; then the process is killed."""
SILENCE_LIMIT = 5.0
"""A process counts as hung when no line of its feed arrives for this long [s]. Every process sends
a sign of life every second."""
PAUSE = 1.0
"""If a turn of the supervisor's loop takes longer than this, the supervisor itself stood still [s]:
it was stopped, or this machine is overloaded."""
SOCKET_NAME = "/cloudrc-12345678/teleop.sock"
"""Longest name of a socket of a run, below the folder for temporary files."""
LOOPBACK = "127.0.0.1"
API_FILE = "api.json"
"""File in a run's folder with the address of the run's API during the flight, for other programs.

cloudrc itself reads the address from the flight file, since it does not trust a run's folder.
"""
AUDIT_FILE = "audit.jsonl"
"""File in a run's folder that logs who sent which command over the API. The file is kept after the
flight."""
UNANNOUNCED = (
    "'cloudrc mission' cannot find this run: no folder for its flight file (XDG_STATE_HOME); give "
    "it --api {}"
)
LINK_FOLDER = "link"
"""Folder in a run's folder for the relay's state and its changed profile during the flight."""


class ProcessDiedError(InvalidRunError):
    """A process ended before the mission was over."""


@dataclass
class Child:
    """A process of the run.

    Attributes:
        name: Name of the process's command.
        process: The process, running or ended.
        log: File with the process's standard error.
        unread: Start of a feed line whose end has not arrived yet.
        heard: When the last line of the feed arrived [s], monotonic clock.
        ready: Whether the process can receive.
        garbled: Whether the process has written a line that is not a record.
    """

    name: str
    process: subprocess.Popen[bytes]
    log: Path
    unread: bytes = field(default=b"")
    heard: float = field(default=0.0)
    ready: bool = field(default=False)
    garbled: bool = field(default=False)

    def last_words(self) -> str:
        """Return the last line of the process's log, or a text that says that the log is empty."""
        lines = self.log.read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else "it left no message"


class LocalRun:
    """The four processes of one run.

    Attributes:
        notes: Notes on this run for the report, a sentence each.
    """

    def __init__(
        self, folder: Path, see: Callable[[list[Record]], None], *, api: bool = True
    ) -> None:
        """Prepare the run; no process is started yet.

        Args:
            folder: Folder of the run. It must contain config.yaml; the run adds world.mcap,
                cloud.mcap and four logs.
            see: Gets the records of the processes' feeds.
            api: Whether the operator gets an API during the flight; the flight file and api.json
                hold the API's address.
        """
        self._folder, self._see, self._api = folder, see, api
        self._key = folder  # replaced by the key file in `fly`
        self._children: list[Child] = []
        self._selector = selectors.DefaultSelector()
        self.notes: tuple[str, ...] = ()

    def fly(self, limit: float) -> None:
        """Fly until teleop reports the end of the mission; then all processes have ended.

        Args:
            limit: Longest duration [s].

        Raises:
            ProcessDiedError: If a process ends too early; the message names the process.
            TimedOutError: If the limit is reached, or if a process falls silent; the message says
                which.
            BadInputError: If no folder for sockets has a short path.
            KeyboardInterrupt: If the user interrupts.
        """
        # A Unix socket's path must be short; the path of the run's folder may be long.
        # The folder is private, since it also holds this run's key.
        with (
            tempfile.TemporaryDirectory(prefix="cloudrc-", dir=socket_folder()) as sockets,
            announced(self._folder, url := self._url(sockets)) as is_announced,
        ):
            if url and not is_announced:
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
            self._wait_until_ready()
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
        """Return the address of the run's API in the folder of the sockets; "" without an API."""
        return f"unix:{sockets}/api.sock" if self._api else ""

    def _start_teleop(self, sockets: str) -> None:
        api: list[str] = []
        if self._api:  # only this user can open the socket file: no token is needed
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
                start_new_session=True,  # Ctrl-C reaches only the supervisor, which ends them
            )
        child = Child(name, process, log)
        assert process.stdout is not None
        os.set_blocking(process.stdout.fileno(), False)
        self._selector.register(process.stdout, selectors.EVENT_READ, child)
        self._children.append(child)

    def _wait_until_ready(self) -> None:
        deadline = Deadline(START_LIMIT, PAUSE)
        while waiting := [child.name for child in self._children if not child.ready]:
            if deadline.passed():
                raise TimedOutError(f"{' and '.join(waiting)}: not ready within {START_LIMIT:g} s")
            self._see(self._listen())
            self._check_alive()

    def _watch(self, limit: float) -> None:
        deadline, paused = Deadline(limit, PAUSE), 0.0
        teleop = next(child for child in self._children if child.name == "teleop")
        for child in self._children:
            child.heard = time.monotonic()
        while teleop.process.poll() is None:
            self._see(self._listen())
            if deadline.passed():
                raise TimedOutError(f"the flight was ended after {limit:g} s, its limit")
            if deadline.pause > paused:
                self._note_pause(deadline.pause - paused)
                paused = deadline.pause
            self._check_alive()
            self._check_silence()
        self._check_alive()
        self._see(self._listen())

    def _note_pause(self, pause: float) -> None:
        """Add a note on the pause, and restart the time limit of each process's silence."""
        text = f"the supervisor of this run stood still for {pause:.1f} s; the flight went on"
        self.notes += (text,)
        self._see([Fault(0, "supervisor", text)])
        for child in self._children:
            child.heard = time.monotonic()

    def _listen(self) -> list[Record]:
        """Return the records of all feeds since the last call; wait at most 50 ms."""
        records: list[Record] = []
        for key, _ in self._selector.select(0.05):
            child: Child = key.data
            data = os.read(key.fd, 65_536)
            if not data:
                self._selector.unregister(key.fileobj)
            *lines, child.unread = (child.unread + data).split(b"\n")
            for line in lines:
                child.heard = time.monotonic()
                if line == READY.encode():
                    child.ready = True
                else:
                    records += _parse_line(child, line)
        return records

    def _check_silence(self) -> None:
        now = time.monotonic()
        for child in self._children:
            if now - child.heard > SILENCE_LIMIT:
                raise TimedOutError(
                    f"the {child.name} process was silent for {SILENCE_LIMIT:g} s and was ended; "
                    f"see {child.log}"
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
        """End the processes that still run: first by SIGTERM, then by SIGKILL."""
        for child in self._children:
            child.process.terminate()
        deadline = time.monotonic() + STOP_LIMIT
        for child in self._children:
            try:
                child.process.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                child.process.kill()
                child.process.wait()
        self._selector.close()
        for child in self._children:
            if child.process.stdout is not None:
                child.process.stdout.close()


def socket_folder() -> str:
    """Choose a folder for temporary files with a path that is short enough for Unix sockets.

    Raises:
        BadInputError: If there is no such folder; the message names TMPDIR.
    """
    given = tempfile.gettempdir()
    for folder in dict.fromkeys((given, os.environ.get("XDG_RUNTIME_DIR", ""), "/tmp")):
        fits = len(os.fsencode(folder)) + len(SOCKET_NAME) <= PATH_MAX
        if folder and fits and os.access(folder, os.W_OK | os.X_OK):
            return folder
    raise BadInputError(
        f"TMPDIR {given} is too long for a socket: its path may have "
        f"{PATH_MAX - len(SOCKET_NAME)} bytes; run with TMPDIR=/tmp"
    )


def _parse_line(child: Child, line: bytes) -> list[Record]:
    """Parse a line of a feed. Report a bad line once per process; the flight continues."""
    try:
        return [from_line(line.decode())]
    except ValueError as error:
        if child.garbled:
            return []
        child.garbled = True
        reason = to_one_line(str(error))[:120]
        return [Fault(0, "feed", f"skipped a line of the {child.name} process: {reason}")]


def _free_addresses(count: int) -> list[str]:
    """Find unused UDP addresses on this machine."""
    return [f"{LOOPBACK}:{port}" for port in free_ports(count)]
