"""What `cloudrc link run` does: it gives the sidecar its clock, sockets, programs and threads."""

from __future__ import annotations

import argparse
import random
import sys
import threading
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from cloudrc.cli.ends import open_exporter, resolve, warn_if_exposed
from cloudrc.cli.output import say
from cloudrc.drivers.process import StopSignal
from cloudrc.records import Counted

if TYPE_CHECKING:
    from cloudrc.cli.tc_session import Programs
    from cloudrc.drivers.exporter import Exporter
    from cloudrc.link.follow import Load, Profiles
    from cloudrc.link.sidecar import Machine, Sidecar


def run(options: argparse.Namespace) -> int:
    """Shape one direction of the link until SIGTERM."""
    stop = StopSignal()  # first: the first process of a container ignores SIGTERM until then
    from cloudrc.cli.link_told import Teller
    from cloudrc.cli.tc_session import runner
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
