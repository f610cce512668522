"""Start and stop the two processes of a link for `cloudrc link verify`, one per direction.

world's end --> `cloudrc link run --direction uplink`   --> cloud's end
cloud's end --> `cloudrc link run --direction downlink` --> world's end
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from cloudrc.assembly import link_profile
from cloudrc.cluster.pods import NO_PROXY
from cloudrc.drivers.machine import interpreter
from cloudrc.drivers.process import PARENT
from cloudrc.drivers.realtime import parse
from cloudrc.errors import (
    BadInputError,
    CloudrcError,
    InvalidRunError,
    MissingPrerequisiteError,
    TimedOutError,
)
from cloudrc.link.state import STATE_FILE, LinkState, from_text
from cloudrc.link.tc import check

if TYPE_CHECKING:
    from cloudrc.config.load import ResolvedExperiment
    from cloudrc.config.schema import Profile

LOOPBACK = "127.0.0.1"
DIRECTIONS = ("uplink", "downlink")
START_LIMIT = 90.0
"""Time limit for both processes to start [s]; a slow machine loads Python for many seconds."""
STOP_LIMIT = 2.0
"""Time limit for both processes to stop before they are killed [s]."""
_POLL_PERIOD = 0.02
_METRICS_TIMEOUT = 3.0
_KINDS = {kind.exit_code: kind for kind in (BadInputError, MissingPrerequisiteError, TimedOutError)}
"""Exit code of a link's process -> class of the error that the code stands for."""
_CHART_ADVICE, _ADVICE = "set link.mode=relay", "use --shaper relay"
"""Advice of a link's process, which names a value of the chart, and the advice that this command
gives instead: a flag."""


@dataclass(frozen=True, slots=True)
class ShaperAddresses:
    """Addresses of one direction's shaper.

    Attributes:
        peer: Destination of its datagrams.
        listen: Where a relay receives datagrams.
        metrics: Where it serves its metrics.
        inside: Prefix of its command line: "ip netns exec NAME", or empty.
    """

    peer: tuple[str, int]
    listen: tuple[str, int]
    metrics: tuple[str, int]
    inside: tuple[str, ...] = ()


@dataclass(slots=True)
class ShaperProcess:
    """Process that shapes one direction.

    Attributes:
        place: Its addresses.
        folder: Folder of its files: route, state, log.
        process: The process, running or ended.
        log: File with its output.
    """

    place: ShaperAddresses
    folder: Path
    process: subprocess.Popen[bytes]
    log: Path = field(init=False)

    def __post_init__(self) -> None:
        self.log = self.folder / "log"

    def route(self) -> tuple[str, int] | None:
        """Return the address to send to; None until it shapes."""
        try:
            return parse((self.folder / "route").read_text(encoding="ascii"))
        except (OSError, ValueError):
            return None

    def state(self) -> LinkState:
        """Read the state that the process has written."""
        return from_text((self.folder / STATE_FILE).read_text(encoding="utf-8"))

    def metrics(self) -> str:
        """Return its metrics as Prometheus text; "" without an answer."""
        host, port = self.place.metrics
        if self.place.inside:  # the namespace has its own loopback
            reader = (
                "import urllib.request as u; ask = u.build_opener(u.ProxyHandler({})).open; "
                f"print(ask('http://{host}:{port}/metrics', timeout=3).read().decode())"
            )
            words = [*self.place.inside, *interpreter("-c", reader)]
            done = subprocess.run(words, capture_output=True, text=True, check=False)
            return done.stdout
        try:
            with NO_PROXY.open(f"http://{host}:{port}/metrics", timeout=_METRICS_TIMEOUT) as page:
                return str(page.read().decode())
        except OSError:
            return ""

    def last_words(self) -> str:
        """Return the last line of its log."""
        lines = self.log.read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else "it left no message"


def check_shaper(asked: Profile | ResolvedExperiment, mode: str) -> None:
    """Refuse a profile that the shaper cannot realise.

    Args:
        asked: Profile of both directions.
        mode: "relay", "netem" or "auto".

    Raises:
        BadInputError: Names the direction and what netem cannot do.
    """
    for way in DIRECTIONS if mode == "netem" else ():
        try:
            check(link_profile(getattr(asked, way)))
        except BadInputError as error:
            raise BadInputError(f"{way}: {error}".replace(_CHART_ADVICE, _ADVICE)) from None


@contextlib.contextmanager
def run_shapers(
    places: Mapping[str, ShaperAddresses], config: str, profile: str, mode: str
) -> Iterator[dict[str, ShaperProcess]]:
    """Run the shapers of both directions; stop them at the end.

    Args:
        places: Addresses by direction.
        config: The experiment, as YAML.
        profile: The profile to apply, as YAML.
        mode: "relay", "netem" or "auto".

    Raises:
        CloudrcError: If a shaper ends early; with its message and exit code.
        TimedOutError: If a shaper does not start in time.
    """
    running: dict[str, ShaperProcess] = {}
    with tempfile.TemporaryDirectory(prefix="cloudrc-verify-") as text:
        folder = Path(text)
        (folder / "experiment.yaml").write_text(config, encoding="utf-8")
        (folder / "profile.yaml").write_text(profile, encoding="utf-8")
        try:
            for way, place in places.items():
                running[way] = _start(folder, way, place, mode)
            _wait(running)
            yield running
        finally:
            _stop([one.process for one in running.values()])


def _start(folder: Path, way: str, place: ShaperAddresses, mode: str) -> ShaperProcess:
    own = folder / way
    own.mkdir()
    command: Sequence[str] = (
        *place.inside,
        *interpreter("-m", "cloudrc", "link", "run"),
        f"--config={folder / 'experiment.yaml'}",
        f"--profile={folder / 'profile.yaml'}",
        f"--direction={way}",
        f"--mode={mode}",
        f"--peer={place.peer[0]}:{place.peer[1]}",
        f"--listen={place.listen[0]}:{place.listen[1]}",
        f"--metrics={place.metrics[0]}:{place.metrics[1]}",
        f"--route={own / 'route'}",
    )
    with (own / "log").open("wb") as log:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            env={**os.environ, PARENT: str(os.getpid())},
            start_new_session=True,  # Ctrl-C reaches this process alone, which stops them
        )
    return ShaperProcess(place, own, process)


def _wait(running: Mapping[str, ShaperProcess]) -> None:
    deadline = time.monotonic() + START_LIMIT
    while not all(one.route() for one in running.values()):
        for way, one in running.items():
            code = one.process.poll()
            if code is not None:
                raise _ended(way, code, one.last_words())
        if time.monotonic() > deadline:
            raise TimedOutError(f"the link was not up within {START_LIMIT:g} s; try again")
        time.sleep(_POLL_PERIOD)


def _ended(way: str, code: int, words: str) -> CloudrcError:
    """Make the error for a process that ended early, with its exit code if that has a meaning."""
    words = words.removeprefix("cloudrc: error: ").replace(_CHART_ADVICE, _ADVICE)
    kind = _KINDS.get(code)
    if kind is None:
        return InvalidRunError(f"the {way} is not shaped: its process ended with {code}: {words}")
    return kind(f"the {way} is not shaped: {words}")


def _stop(processes: Sequence[subprocess.Popen[bytes]]) -> None:
    for process in processes:
        with contextlib.suppress(OSError):
            os.kill(process.pid, signal.SIGCONT)
        process.terminate()
    deadline = time.monotonic() + STOP_LIMIT
    for process in processes:
        try:
            process.wait(max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
