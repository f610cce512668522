"""What `cloudrc link run` does: it gives the sidecar its clock, sockets, programs and threads.

tc kept running: commands go in as lines, answers come out without starting a process for each.

A step of a time line has to be in force within milliseconds, and a process takes longer than that
to start. `tc -batch -` reads its commands from a pipe and answers each as soon as it is done; after
each a listing is asked for, whose line marks the end of the answer.

What `cloudrc link run` answers at /link.json of its metrics' port: who shapes, by what, and how.

Tools are started for each answer, so that nobody may have one more often than once a second.
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

from cloudrc.cli.output import say
from cloudrc.cli.runtime import open_exporter, resolve, warn_if_exposed
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
    stop = StopSignal()  # first: the first process of a container ignores SIGTERM until then
    from cloudrc.link.follow import HANDED_FILE, HandedProfile, ProfileFile, Profiles
    from cloudrc.link.sidecar import Settings, Sidecar
    from cloudrc.link.tc import write_tables

    warn_if_exposed(options.listen)
    exporter = open_exporter(options, "link")
    watcher = Metrics(exporter, options.direction, options.mode) if exporter else None
    load, handed = loader(options.direction), options.route.with_name(HANDED_FILE)
    file = Profiles(ProfileFile(options.profile, load, log), HandedProfile(handed, load, log))
    profile, state = file.first(), options.route.with_name("link.json")
    settings = Settings(options.mode, options.direction, options.route, state)
    with TemporaryDirectory(prefix="tc-", dir=options.route.parent) as tables:
        write_tables(Path(tables))
        programs = runner(tables)
        machine = _machine(options, programs, Path(tables))
        sidecar = Sidecar(settings, machine, profile, watcher)
        if exporter:
            exporter.tells(Teller(sidecar).text)
        try:
            sidecar.run(stop, lambda: _follow(sidecar, file, options, watcher))
        finally:
            programs.close()
    return 0


def log(line: str) -> None:
    """Say one line to people."""
    say(f"cloudrc link: {line}", sys.stderr)


def loader(direction: str) -> Load:
    """Make what reads a profile's file and takes one direction of it."""
    from cloudrc.assembly import link_profile
    from cloudrc.config.load import load_profile
    from cloudrc.link.follow import Loaded

    def load(path: Path) -> Loaded:
        profile = load_profile(path.absolute())  # with a slash: no shipped profile's name
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
        if not ask_for_fifo():  # most pods may not, and need not
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


def _follow(
    sidecar: Sidecar, file: Profiles, options: argparse.Namespace, watcher: Metrics | None
) -> None:
    """Let threads of their own look after the profile's file and the peer's name."""
    from cloudrc.link.follow import PEER_PAUSE, PROFILE_PERIOD, PeerName

    name = PeerName(options.peer, resolve, log)

    def look() -> None:
        sidecar.profile = file.poll() or sidecar.profile

    def ask() -> None:
        sidecar.peer = name.poll() or sidecar.peer
        if watcher is not None:
            watcher.unresolved(name.failures)

    for action, pause in ((look, (PROFILE_PERIOD, PROFILE_PERIOD)), (ask, PEER_PAUSE)):
        threading.Thread(target=_again_and_again, args=(pause, action), daemon=True).start()


def _again_and_again(pause: tuple[float, float], action: Callable[[], None]) -> None:
    """Act for ever, with a pause between that is drawn from a range [s]."""
    while True:
        action()
        time.sleep(random.uniform(*pause))


class Metrics:
    """Keeps the metrics of a sidecar; a `Watcher`."""

    def __init__(self, exporter: Exporter, direction: str, mode: str) -> None:
        self._exporter = exporter
        self._direction = direction
        self._mode = mode

    def shapes(self, shaper: str) -> None:
        """Show who shapes, and be ready."""
        self._exporter.shaped(shaper, self._direction, self._mode)
        self._exporter.ready(True)

    def asked(self, delay: float) -> None:
        """Show the mean delay that is asked for [s]."""
        self._exporter.asked(self._direction, delay)

    def unresolved(self, count: int) -> None:
        """Show how often the peer's name could not be resolved."""
        self._exporter.unresolved(count)

    def counted(self, stamp_ns: int, counts: dict[str, int]) -> None:
        """Show what became of the datagrams."""
        self._exporter.see([Counted(stamp_ns, "link", name, n) for name, n in counts.items()])


PATIENCE = 5.0
"""How long tc and ip may take [s]."""
NOT_FOUND = 127
_FAILED = b"Command failed -:"
_PIPE = 65_536
_BATCH = ("tc", "-s", "-j", "-force", "-batch", "-")
_END = "qdisc show dev lo"


def runner(tables: str, prefix: Sequence[str] = ()) -> Programs:
    """Make what runs tc and ip.

    Args:
        tables: Folder in which tc finds its distributions.
        prefix: Words before each program, such as "ip netns exec NAME".
    """
    return Programs({**os.environ, "TC_LIB_DIR": tables, "LC_ALL": "C"}, prefix)


class Programs:
    """Runs tc and ip; changes and listings of qdiscs through one tc that keeps running."""

    def __init__(self, environment: Mapping[str, str], prefix: Sequence[str] = ()) -> None:
        """Start nothing yet."""
        self._environment, self._prefix = environment, tuple(prefix)
        self._session: Session | None = None

    def __call__(self, words: Sequence[str]) -> Answer:
        """Run a program to its end."""
        line = _for_batch(words)
        if line is None:
            return self._once(words)
        try:
            if self._session is None:
                self._session = Session((*self._prefix, *_BATCH), self._environment)
            return self._session.ask(line, lists=words[1].startswith("-"))
        except (OSError, SessionError):
            # It was killed, or is too old for this: once more, as everybody does it.
            self.close()
            return self._once(words)

    def close(self) -> None:
        """End the tc that keeps running, if there is one."""
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
                timeout=PATIENCE,
                check=False,
            )
        except FileNotFoundError:
            return Answer(NOT_FOUND, "", "")
        except OSError as error:  # no leave to run it, or no process left
            return Answer(1, "", error.strerror or str(error))
        except subprocess.TimeoutExpired:
            return Answer(1, "", f"no answer within {PATIENCE:g} s")
        return Answer(done.returncode, done.stdout, done.stderr)


class SessionError(Exception):
    """The tc that keeps running does not answer as expected."""


class Session:
    """One `tc -batch -`."""

    def __init__(self, command: Sequence[str], environment: Mapping[str, str]) -> None:
        """Start it; raises an OSError."""
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
        """Have one command done.

        Args:
            line: The words after `tc`, options left out.
            lists: Whether a line of JSON is its answer; else it says nothing if all is well.

        Raises:
            SessionError: If there is no answer, or none that makes sense; then close it.
        """
        os.write(self._in, f"{line}\n{_END}\n".encode())
        until, said, answer = time.monotonic() + PATIENCE, b"", ""
        listings: list[str] = []
        complaints: list[str] = []
        while len(listings) < (2 if lists and not complaints else 1):
            end = said.find(b"\n")
            if end < 0:
                said += self._read(until)
                continue
            one, said = said[:end], said[end + 1 :]
            if one.startswith(_FAILED):
                complaints.append("")
            elif one.startswith(b"["):
                listings.append(one.decode())
            elif one.strip():
                answer += one.decode(errors="replace") + "\n"
        if complaints:
            return Answer(2, "", answer)
        return Answer(0, listings[0] if lists else answer, "")

    def _read(self, until: float) -> bytes:
        ready, _, _ = select.select([self._out], [], [], max(0.0, until - time.monotonic()))
        said = os.read(self._out, _PIPE) if ready else b""
        if not said:
            raise SessionError("it has ended" if ready else "no answer")
        return said

    def close(self) -> None:
        """End it."""
        process = self._process
        process.kill()
        process.wait()
        for pipe in (process.stdin, process.stdout):
            if pipe is not None:
                pipe.close()


def _for_batch(words: Sequence[str]) -> str | None:
    """Put a command into a line for the tc that keeps running; None if that is not worth it."""
    match list(words):
        case ["tc", "qdisc", "change", *rest]:
            return " ".join(["qdisc", "change", *rest])
        case ["tc", "-s", "-j", "qdisc", "show", *rest]:
            return " ".join(["qdisc", "show", *rest])
    return None


PERIOD = 1.0
"""For so long an answer is given again [s]."""
NOTHING = "{}\n"
"""Before anything is shaped."""


def look(host: str, inside: Sequence[str] = ()) -> Near | None:
    """Ask a network namespace for its netems and its way to a host, with tools of our own.

    Args:
        host: IPv4 address.
        inside: Words that lead there, "ip netns exec NAME"; none: this one.
    """
    programs = runner("", inside)
    try:
        return look_near(programs, host)
    finally:
        programs.close()


class Teller:
    """Tells what a sidecar does, to any thread."""

    def __init__(
        self,
        sidecar: Sidecar,
        look: Callable[[str], Near | None] = look,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._sidecar, self._look, self._clock = sidecar, look, clock
        self._guard, self._text, self._until = threading.Lock(), NOTHING, -PERIOD

    def text(self) -> str:
        """Say all there is to know now, as JSON; the last answer where tools hang."""
        if not self._guard.acquire(timeout=PERIOD):
            return self._text
        try:
            if self._clock() >= self._until:
                self._text = self._ask()
                self._until = self._clock() + PERIOD
            return self._text
        finally:
            self._guard.release()

    def _ask(self) -> str:
        told, peer = self._sidecar.told(), self._sidecar.peer
        if told is None or peer is None:
            return NOTHING
        return write_told(replace(told, near=self._look(peer[0])))
