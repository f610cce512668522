"""Run `cloudrc link run`: the sidecar with its clock, sockets, programs and threads.

A step of a profile's time line must take effect within milliseconds, and starting a process takes
longer. Therefore one `tc -batch -` keeps running: it reads commands from a pipe. A listing follows
each command; its line marks the end of the answer.

/link.json on the metrics port shows the state of the shaper. Each answer starts external tools, so
it is renewed at most once a second.
"""

from __future__ import annotations

import argparse
import os
import random
import select
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from cloudrc.cli.output import print_line
from cloudrc.cli.runtime import ipv4_addresses, open_exporter, warn_if_exposed
from cloudrc.drivers.process import StopSignal
from cloudrc.link.sidecar import Near, look_near, write_told
from cloudrc.link.tc import Answer
from cloudrc.records import Counted

if TYPE_CHECKING:
    from cloudrc.drivers.exporter import Exporter
    from cloudrc.link.follow import Load, Profiles
    from cloudrc.link.sidecar import Machine, Sidecar


def run(options: argparse.Namespace) -> int:
    """Shape one direction of the link until SIGTERM."""
    stop = StopSignal()  # first: until then, process 1 of a container ignores SIGTERM
    from cloudrc.link.follow import HANDED_FILE, HandedProfile, ProfileFile, Profiles
    from cloudrc.link.sidecar import Settings, Sidecar
    from cloudrc.link.tc import write_tables

    warn_if_exposed(options.listen)
    exporter = open_exporter(options, "link")
    metrics = Metrics(exporter, options.direction, options.mode) if exporter else None
    load, handed_path = make_profile_loader(options.direction), options.route.with_name(HANDED_FILE)
    profile_file = ProfileFile(options.profile, load, log)
    profiles = Profiles(profile_file, HandedProfile(handed_path, load, log))
    profile, state_path = profiles.first(), options.route.with_name("link.json")
    settings = Settings(options.mode, options.direction, options.route, state_path)
    with TemporaryDirectory(prefix="tc-", dir=options.route.parent) as tables:
        write_tables(Path(tables))
        programs = make_programs(tables)
        machine = _machine(options, programs, Path(tables))
        sidecar = Sidecar(settings, machine, profile, metrics)
        if exporter:
            exporter.tells(LinkStatusSource(sidecar).text)
        try:
            sidecar.run(stop, lambda: _start_watching(sidecar, profiles, options, metrics))
        finally:
            programs.close()
    return 0


def log(line: str) -> None:
    """Write one line to the log."""
    print_line(f"cloudrc link: {line}", sys.stderr)


def make_profile_loader(direction: str) -> Load:
    """Make the function that reads one direction of a profile file."""
    from cloudrc.assembly import link_profile
    from cloudrc.config.load import load_profile
    from cloudrc.link.follow import Loaded

    def load(path: Path) -> Loaded:
        profile = load_profile(path.absolute())  # absolute: never the name of a shipped profile
        values = profile.model_dump(mode="json", exclude_defaults=True)
        return Loaded(link_profile(getattr(profile, direction)), values)

    return load


def _machine(options: argparse.Namespace, programs: Programs, tables: Path) -> Machine:
    from cloudrc.config.load import read_experiment
    from cloudrc.link.model import LinkDirection
    from cloudrc.link.netem import Netem
    from cloudrc.link.profile import DirectionProfile
    from cloudrc.link.relay import RelayShaper, ask_for_fifo, settle
    from cloudrc.link.sidecar import Machine
    from cloudrc.link.tc import may_shape, try_netem
    from cloudrc.tunnel.codec import peek

    seed = read_experiment(str(options.config)).seed
    clock = time.monotonic_ns

    def relay(profile: DirectionProfile, origin_ns: int) -> RelayShaper:
        settle()
        if not ask_for_fifo():  # most pods lack the permission and do not need it
            log("the relay runs under SCHED_FIFO")
        uplink = options.direction == "uplink"
        return RelayShaper(options.listen, LinkDirection(profile, seed, uplink, origin_ns), peek)

    def netem(profile: DirectionProfile, origin_ns: int) -> Netem:
        return Netem(
            programs,
            profile,
            origin_ns=origin_ns,
            clock=clock,
            wait=time.sleep,
            tables=tables,
            log=log,
        )

    return Machine(
        relay=relay,
        netem=netem,
        may_shape=may_shape(Path("/proc/self/status").read_text(encoding="ascii")),
        try_netem=lambda: try_netem(programs),
        clock=clock,
        today=lambda: datetime.now(UTC).isoformat(timespec="seconds"),
        wait=time.sleep,
        log=log,
    )


def _start_watching(
    sidecar: Sidecar, profiles: Profiles, options: argparse.Namespace, metrics: Metrics | None
) -> None:
    """Start the threads that watch the profile file and resolve the peer's name."""
    from cloudrc.link.follow import PEER_PAUSE, PROFILE_PERIOD, PeerName

    name = PeerName(options.peer, ipv4_addresses, log)

    def poll_profile() -> None:
        sidecar.profile = profiles.poll() or sidecar.profile

    def resolve_peer() -> None:
        sidecar.peer = name.poll() or sidecar.peer
        if metrics is not None:
            metrics.unresolved(name.failures)

    tasks = ((poll_profile, (PROFILE_PERIOD, PROFILE_PERIOD)), (resolve_peer, PEER_PAUSE))
    for action, pause in tasks:
        threading.Thread(target=_repeat_forever, args=(pause, action), daemon=True).start()


def _repeat_forever(pause: tuple[float, float], action: Callable[[], None]) -> None:
    """Repeat an action; each pause is drawn at random from a range [s]."""
    while True:
        action()
        time.sleep(random.uniform(*pause))


class Metrics:
    """Export the metrics of a sidecar; implements `Watcher`."""

    def __init__(self, exporter: Exporter, direction: str, mode: str) -> None:
        self._exporter = exporter
        self._direction = direction
        self._mode = mode

    def shapes(self, shaper: str) -> None:
        """Export which shaper is in use, and report ready."""
        self._exporter.shaped(shaper, self._direction, self._mode)
        self._exporter.ready(True)

    def asked(self, delay: float) -> None:
        """Export the mean of the requested delay [s]."""
        self._exporter.asked(self._direction, delay)

    def unresolved(self, count: int) -> None:
        """Export how often the peer's name could not be resolved."""
        self._exporter.unresolved(count)

    def counted(self, stamp_ns: int, counts: dict[str, int]) -> None:
        """Export the counters of datagrams."""
        self._exporter.see([Counted(stamp_ns, "link", name, n) for name, n in counts.items()])


TOOL_TIMEOUT = 5.0
"""Time limit of one call of tc or ip [s]."""
NOT_FOUND = 127
"""Exit code when the program does not exist."""
_FAILED = b"Command failed -:"
_READ_SIZE = 65_536
_BATCH = ("tc", "-s", "-j", "-force", "-batch", "-")
_END = "qdisc show dev lo"  # its listing marks the end of an answer


def make_programs(tables: str, prefix: Sequence[str] = ()) -> Programs:
    """Make the runner of tc and ip.

    Args:
        tables: Folder with the distribution tables of tc.
        prefix: Words before each command, such as "ip netns exec NAME".
    """
    return Programs({**os.environ, "TC_LIB_DIR": tables, "LC_ALL": "C"}, prefix)


class Programs:
    """Run tc and ip; changes and listings of qdiscs go through one lasting tc process."""

    def __init__(self, environment: Mapping[str, str], prefix: Sequence[str] = ()) -> None:
        """Store the environment and the prefix; start no process."""
        self._environment, self._prefix = environment, tuple(prefix)
        self._session: TcSession | None = None

    def __call__(self, words: Sequence[str]) -> Answer:
        """Run a command and return its answer."""
        line = _for_batch(words)
        if line is None:
            return self._once(words)
        try:
            if self._session is None:
                self._session = TcSession((*self._prefix, *_BATCH), self._environment)
            return self._session.ask(line, lists=words[1].startswith("-"))
        except (OSError, SessionError):
            # The tc process was killed, or is too old for -batch: start one for this command.
            self.close()
            return self._once(words)

    def close(self) -> None:
        """End the lasting tc process, if there is one."""
        if self._session is not None:
            self._session.close()
            self._session = None

    def _once(self, words: Sequence[str]) -> Answer:
        try:
            done = subprocess.run(
                (*self._prefix, *words),
                capture_output=True,
                text=True,
                env=self._environment,
                timeout=TOOL_TIMEOUT,
                check=False,
            )
        except FileNotFoundError:
            return Answer(NOT_FOUND, "", "")
        except OSError as error:  # no permission, or the limit of processes is reached
            return Answer(1, "", error.strerror or str(error))
        except subprocess.TimeoutExpired:
            return Answer(1, "", f"no answer within {TOOL_TIMEOUT:g} s")
        return Answer(done.returncode, done.stdout, done.stderr)


class SessionError(Exception):
    """The lasting tc process does not answer as expected."""


class TcSession:
    """Talk to one `tc -batch -` process."""

    def __init__(self, command: Sequence[str], environment: Mapping[str, str]) -> None:
        """Start the process; raises OSError."""
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env=environment,
            bufsize=0,
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._in, self._out = self._process.stdin.fileno(), self._process.stdout.fileno()

    def ask(self, line: str, *, lists: bool) -> Answer:
        """Run one command.

        Args:
            line: The words after `tc`, without options.
            lists: Whether it answers with a line of JSON; else it is silent on success.

        Raises:
            SessionError: If there is no valid answer; close the session then.
        """
        os.write(self._in, f"{line}\n{_END}\n".encode())
        deadline, unread, text = time.monotonic() + TOOL_TIMEOUT, b"", ""
        listings: list[str] = []
        failed = False
        while len(listings) < (2 if lists and not failed else 1):
            end = unread.find(b"\n")
            if end < 0:
                unread += self._read(deadline)
                continue
            one, unread = unread[:end], unread[end + 1 :]
            if one.startswith(_FAILED):
                failed = True
            elif one.startswith(b"["):
                listings.append(one.decode())
            elif one.strip():
                text += one.decode(errors="replace") + "\n"
        if failed:
            return Answer(2, "", text)
        return Answer(0, listings[0] if lists else text, "")

    def _read(self, deadline: float) -> bytes:
        ready, _, _ = select.select([self._out], [], [], max(0.0, deadline - time.monotonic()))
        data = os.read(self._out, _READ_SIZE) if ready else b""
        if not data:
            raise SessionError("the process has ended" if ready else "no answer")
        return data

    def close(self) -> None:
        """End the process."""
        process = self._process
        process.kill()
        process.wait()
        for pipe in (process.stdin, process.stdout):
            if pipe is not None:
                pipe.close()


def _for_batch(words: Sequence[str]) -> str | None:
    """Translate a command into a line for the lasting tc; None for rare commands."""
    match list(words):
        case ["tc", "qdisc", "change", *rest]:
            return " ".join(["qdisc", "change", *rest])
        case ["tc", "-s", "-j", "qdisc", "show", *rest]:
            return " ".join(["qdisc", "show", *rest])
    return None


STATUS_PERIOD = 1.0
"""Time for which an answer of /link.json stays valid [s]."""
EMPTY_STATUS = "{}\n"
"""Answer of /link.json before anything is shaped."""


def inspect_network(host: str, inside: Sequence[str] = ()) -> Near | None:
    """Find the netem qdiscs of a network namespace and its route to a host.

    Args:
        host: IPv4 address.
        inside: Prefix of commands, "ip netns exec NAME"; empty for this namespace.
    """
    programs = make_programs("", inside)
    try:
        return look_near(programs, host)
    finally:
        programs.close()


class LinkStatusSource:
    """Describe the state of a sidecar as JSON; for any thread."""

    def __init__(
        self,
        sidecar: Sidecar,
        look: Callable[[str], Near | None] = inspect_network,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._sidecar, self._look, self._clock = sidecar, look, clock
        self._lock, self._text, self._valid_until = threading.Lock(), EMPTY_STATUS, -STATUS_PERIOD

    def text(self) -> str:
        """Return the state as JSON; the previous answer if the tools hang."""
        if not self._lock.acquire(timeout=STATUS_PERIOD):
            return self._text
        try:
            if self._clock() >= self._valid_until:
                self._text = self._ask()
                self._valid_until = self._clock() + STATUS_PERIOD
            return self._text
        finally:
            self._lock.release()

    def _ask(self) -> str:
        status, peer = self._sidecar.told(), self._sidecar.peer
        if status is None or peer is None:
            return EMPTY_STATUS
        return write_told(replace(status, near=self._look(peer[0])))
