"""The two processes of a link, started for a test of themselves: each shapes one way, as in pods.

world's shore --> `cloudrc link run --direction uplink`   --> cloud's shore
cloud's shore --> `cloudrc link run --direction downlink` --> world's shore
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
from cloudrc.cluster.pods import DIRECTLY
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
WAYS = ("uplink", "downlink")
START_LIMIT = 90.0
"""For both to shape; a slow machine takes many seconds to load Python [s]."""
STOP_LIMIT = 2.0
_LOOK = 0.02
_PATIENCE = 3.0
_KINDS = {kind.exit_code: kind for kind in (BadInputError, MissingPrerequisiteError, TimedOutError)}
"""Exit codes of a link's process that say whose fault its end is."""
_CHART_ADVICE, _ADVICE = "set link.mode=relay", "use --shaper relay"
"""What a link's process advises is a value of the chart; here it is a flag."""


@dataclass(frozen=True, slots=True)
class Place:
    """Where one direction's shaper runs.

    Attributes:
        peer: Where its datagrams end.
        listen: Where it takes them in, if it is a relay.
        metrics: Where it tells of itself.
        inside: Words before its command line: "ip netns exec NAME", or none.
    """

    peer: tuple[str, int]
    listen: tuple[str, int]
    metrics: tuple[str, int]
    inside: tuple[str, ...] = ()


@dataclass(slots=True)
class Shaping:
    """One direction's process.

    Attributes:
        place: Where it runs.
        folder: Its files: route, state, log.
        process: Running or ended.
    """

    place: Place
    folder: Path
    process: subprocess.Popen[bytes]
    log: Path = field(init=False)

    def __post_init__(self) -> None:
        self.log = self.folder / "log"

    def route(self) -> tuple[str, int] | None:
        """Where to send, once it shapes."""
        try:
            return parse((self.folder / "route").read_text(encoding="ascii"))
        except (OSError, ValueError):
            return None

    def state(self) -> LinkState:
        """What it says that it does."""
        return from_text((self.folder / STATE_FILE).read_text(encoding="utf-8"))

    def metrics(self) -> str:
        """What it counts, in Prometheus' text; "" if it does not answer."""
        host, port = self.place.metrics
        if self.place.inside:  # its loopback is not ours
            reader = (
                "import urllib.request as u; ask = u.build_opener(u.ProxyHandler({})).open; "
                f"print(ask('http://{host}:{port}/metrics', timeout=3).read().decode())"
            )
            words = [*self.place.inside, *interpreter("-c", reader)]
            done = subprocess.run(words, capture_output=True, text=True, check=False)
            return done.stdout
        try:
            with DIRECTLY.open(f"http://{host}:{port}/metrics", timeout=_PATIENCE) as page:
                return str(page.read().decode())
        except OSError:
            return ""

    def last_words(self) -> str:
        """The last line of its log."""
        lines = self.log.read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else "it left no message"


def refuse_impossible(asked: Profile | ResolvedExperiment, mode: str) -> None:
    """Refuse what a shaper cannot be, before anything is planned or started for it.

    Args:
        asked: Has what is asked of both directions.
        mode: "relay", "netem" or "auto".

    Raises:
        BadInputError: Names the direction and what of it netem cannot do.
    """
    for way in WAYS if mode == "netem" else ():
        try:
            check(link_profile(getattr(asked, way)))
        except BadInputError as error:
            raise BadInputError(f"{way}: {error}".replace(_CHART_ADVICE, _ADVICE)) from None


@contextlib.contextmanager
def shaping(
    places: Mapping[str, Place], config: str, profile: str, mode: str
) -> Iterator[dict[str, Shaping]]:
    """Run both directions' shapers; they have ended afterwards.

    Args:
        places: By direction.
        config: The experiment, as YAML.
        profile: The profile in force, as YAML.
        mode: "relay", "netem" or "auto".

    Raises:
        CloudrcError: If one cannot shape: it says why, and its exit code is the error's.
        TimedOutError: If one does not begin to.
    """
    running: dict[str, Shaping] = {}
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


def _start(folder: Path, way: str, place: Place, mode: str) -> Shaping:
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
            start_new_session=True,  # Ctrl-C reaches this process alone, which ends them
        )
    return Shaping(place, own, process)


def _wait(running: Mapping[str, Shaping]) -> None:
    until = time.monotonic() + START_LIMIT
    while not all(one.route() for one in running.values()):
        for way, one in running.items():
            code = one.process.poll()
            if code is not None:
                raise _ended(way, code, one.last_words())
        if time.monotonic() > until:
            raise TimedOutError(f"the link was not up within {START_LIMIT:g} s; try again")
        time.sleep(_LOOK)


def _ended(way: str, code: int, words: str) -> CloudrcError:
    """Say why a direction's process has ended, with its own exit code where that says why."""
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
    until = time.monotonic() + STOP_LIMIT
    for process in processes:
        try:
            process.wait(max(0.0, until - time.monotonic()))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
