"""Start a link on this machine, one process per direction, and probe it both ways.

netem is verified between two network namespaces, joined by a veth pair, as between two pods. This
needs root, changes nothing outside the namespaces, and deletes them at the end.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import socket
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from cloudrc.assembly import link_profile
from cloudrc.cli.link_verify_release import fetch
from cloudrc.config.document import write_yaml
from cloudrc.config.load import ResolvedExperiment, dump
from cloudrc.config.schema import Profile
from cloudrc.drivers.machine import interpreter
from cloudrc.drivers.process import PARENT
from cloudrc.drivers.realtime import bind, free_ports, parse
from cloudrc.errors import BadInputError, InvalidRunError, MissingPrerequisiteError, TimedOutError
from cloudrc.link.sidecar import read_told
from cloudrc.link.state import STATE_FILE, from_text
from cloudrc.link.tc import check
from cloudrc.link.verify.causes import Findings, read_evidence, read_metrics
from cloudrc.link.verify.expect import Flow, Plan
from cloudrc.link.verify.judge import judge, look_twice, verdict_of
from cloudrc.link.verify.probe import PROBE, ProbeEnd, plan_probes, send_probes
from cloudrc.tunnel.codec import SIZES, Kind

KINDS = {"uplink": Kind.TELEMETRY, "downlink": Kind.COMMAND}
START_LIMIT, STOP_LIMIT = 90.0, 2.0
"""Longest time for both processes to start, which a slow disk needs, and to stop [s]."""
COUNTS_WAIT = 1.3
"""Time until the processes have counted the last probe [s]; they do so once a second."""
LOOPBACK, DEVICE, PORT = "127.0.0.1", "tunnel", 7400
HOSTS = {"uplink": "10.79.7.1", "downlink": "10.79.7.2"}
"""Direction -> address of its sending end, in that end's namespace."""
_CLONE_NEWNET = 0x40000000  # linux include/uapi/linux/sched.h
_ERRORS = {
    kind.exit_code: kind for kind in (BadInputError, MissingPrerequisiteError, TimedOutError)
}


@dataclass(slots=True)
class Way:
    """One direction of a link under test.

    Attributes:
        own: Socket that sends its probes.
        peer: Address of the other end.
        ports: Where a relay receives, and where the process serves its pages.
        namespace: Name of its network namespace; "" for this process's.
        folder: Files of its process.
        process: The process that shapes it.
    """

    own: socket.socket
    peer: tuple[str, int]
    ports: tuple[int, int]
    namespace: str = ""
    folder: Path = Path()
    process: subprocess.Popen[bytes] | None = None

    def get(self, page: str) -> str:
        """Fetch a page of the process; "" without an answer."""
        with inside(self.namespace):
            return fetch(f"http://{LOOPBACK}:{self.ports[1]}/{page}")


def verify(
    experiment: ResolvedExperiment,
    shaper: str,
    seconds: float | None,
    tell: Callable[[str], None],
    applied: Profile | None = None,
    meddle: Callable[[Mapping[str, Way]], None] = lambda ways: None,
) -> tuple[dict[str, Findings], dict[str, Plan]]:
    """Measure whether a link matches its profile; what is off is looked at twice.

    Args:
        experiment: The experiment.
        shaper: "relay" or "netem".
        seconds: Time to send probes [s]; None for as long as needed.
        tell: Receives progress as text.
        applied: Profile in force instead of the requested one; tests inject faults with it.
        meddle: Gets the running link before the first probe; tests inject faults with it.
    """
    plans, found = make_plans(experiment, seconds, shaper), list[dict[str, Findings]]()
    longest = max(plan.sent[-1] for plan in plans.values())
    for look in ("probing the link", "looking once more at what is off"):
        tell(f"{look}: {longest:.0f} s")
        with run_link(experiment, shaper, applied) as ways:
            meddle(ways)
            found.append(probe_link(ways, plans))
        if "off" not in {verdict_of(one.rows) for one in found[0].values()}:
            return found[0], plans
    both = {way: look_twice(*(one[way].rows for one in found)) for way in plans}
    return {way: found[1][way]._replace(rows=rows) for way, rows in both.items()}, plans


def make_plans(
    experiment: ResolvedExperiment, seconds: float | None, shaper: str
) -> dict[str, Plan]:
    """Plan probes for `seconds` [s], as large as the tunnel's datagrams; None: as long as needed.

    Raises:
        BadInputError: If the shaper cannot realise the profile; names the direction.
    """
    plans = {}
    for way, kind in KINDS.items():
        profile = link_profile(getattr(experiment, way))
        if shaper == "netem":
            try:
                check(profile)
            except BadInputError as error:
                raise BadInputError(_advise(f"{way}: {error}")) from None
        flow = Flow(experiment.seed, way == "uplink", PROBE, SIZES[kind])
        plans[way] = plan_probes(profile, flow, seconds, drawn=shaper == "netem")
    return plans


def _advise(text: str) -> str:
    """Replace the advice for a chart by the one for this command."""
    return text.replace("set link.mode=relay", "use --shaper relay")


@contextlib.contextmanager
def run_link(
    experiment: ResolvedExperiment, shaper: str, applied: Profile | None = None
) -> Iterator[dict[str, Way]]:
    """Run both directions of a link: on loopback, or for netem in two namespaces.

    Raises:
        CloudrcError: If a process ends early, with its message and exit code, or starts too slowly.
    """
    profile = applied or Profile(uplink=experiment.uplink, downlink=experiment.downlink)
    text = write_yaml(profile.model_dump(mode="json", exclude_defaults=True))
    with contextlib.ExitStack() as stack:
        ways = stack.enter_context(_open_namespaces() if shaper == "netem" else _open_loopback())
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="cloudrc-verify-")))
        (folder / "experiment.yaml").write_text(dump(experiment), encoding="utf-8")
        (folder / "profile.yaml").write_text(text, encoding="utf-8")
        for name, way in ways.items():
            way.folder = folder / name
            way.folder.mkdir()
            way.process = _start(name, way, shaper)
            stack.callback(_stop, way.process)
        deadline = time.monotonic() + START_LIMIT
        while not all((way.folder / "route").exists() for way in ways.values()):
            for name, way in ways.items():
                _check_alive(name, way)
            if time.monotonic() > deadline:
                raise TimedOutError(f"the link was not up within {START_LIMIT:g} s; try again")
            time.sleep(0.02)
        yield ways


def _start(name: str, way: Way, shaper: str) -> subprocess.Popen[bytes]:
    relay, pages = (f"{LOOPBACK}:{port}" for port in way.ports)
    options = {
        "config": way.folder.parent / "experiment.yaml",
        "profile": way.folder.parent / "profile.yaml",
        "route": way.folder / "route",
        "direction": name,
        "mode": shaper,
        "peer": f"{way.peer[0]}:{way.peer[1]}",
        "listen": relay,
        "metrics": pages,
    }
    words = [f"--{option}={value}" for option, value in options.items()]
    with (way.folder / "log").open("wb") as log, inside(way.namespace):
        return subprocess.Popen(
            interpreter("-m", "cloudrc", "link", "run", *words),
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            env={**os.environ, PARENT: str(os.getpid())},
            start_new_session=True,  # Ctrl-C reaches this process alone, which stops them
        )


def _check_alive(name: str, way: Way) -> None:
    code = way.process.poll() if way.process else None
    if code is not None:
        lines = (way.folder / "log").read_text(errors="replace").strip().splitlines()
        words = _advise((lines or ["it left no message"])[-1].removeprefix("cloudrc: error: "))
        if code in _ERRORS:
            raise _ERRORS[code](f"the {name} is not shaped: {words}")
        raise InvalidRunError(f"the {name} is not shaped: its process ended with {code}: {words}")


def _stop(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(STOP_LIMIT)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def probe_link(ways: Mapping[str, Way], plans: Mapping[str, Plan]) -> dict[str, Findings]:
    """Send all probes over a running link and judge them."""
    since_wall_ns, ends = time.time_ns() - time.monotonic_ns(), []
    for name, way in ways.items():
        state = from_text((way.folder / STATE_FILE).read_text(encoding="utf-8"))
        route = parse((way.folder / "route").read_text(encoding="ascii"))
        origin_ns = (state.origin_ns or 0) + since_wall_ns
        ends.append(ProbeEnd(way.own, route, plans[name], origin_ns))
    streams = send_probes(ends)
    time.sleep(COUNTS_WAIT)
    found = {}
    for (name, way), stream in zip(ways.items(), streams, strict=True):
        plan, told = plans[name], read_told(way.get("link.json"))
        evidence = read_evidence(told, read_metrics(way.get("metrics")), len(stream.sent))
        expected = plan.expected(stream)
        rows = judge(plan, stream, expected, plan.applied(evidence.applied))
        found[name] = Findings(rows, evidence)
    return found


@contextlib.contextmanager
def _open_loopback() -> Iterator[dict[str, Way]]:
    """Open both ends of a link on loopback."""
    with bind((LOOPBACK, 0)) as up, bind((LOOPBACK, 0)) as down:
        ports = zip(free_ports(2), free_ports(2, socket.SOCK_STREAM), strict=True)
        yield {
            "uplink": Way(up, down.getsockname(), next(ports)),
            "downlink": Way(down, up.getsockname(), next(ports)),
        }


@contextlib.contextmanager
def _open_namespaces() -> Iterator[dict[str, Way]]:
    """Create two namespaces and open an end of a link in each."""
    if os.geteuid() != 0:
        raise MissingPrerequisiteError(
            "netem is verified between two network namespaces, which needs root; run this as root,"
            " or verify the relay (--shaper relay)"
        )
    names = {way: f"cloudrc-{way}-{os.getpid()}" for way in HOSTS}
    near, far = names.values()
    with contextlib.ExitStack() as stack:
        for name in names.values():
            _ip("netns", "add", name)
            stack.callback(_ip, "netns", "del", name)
        _ip("-n", near, "link", "add", DEVICE, "type", "veth", "peer", DEVICE, "netns", far)
        ways = {}
        for (way, name), peer in zip(names.items(), reversed(HOSTS.values()), strict=True):
            _ip("-n", name, "addr", "add", f"{HOSTS[way]}/24", "dev", DEVICE)
            for device in ("lo", DEVICE):
                _ip("-n", name, "link", "set", device, "up")
            with inside(name):
                own = stack.enter_context(bind((HOSTS[way], PORT)))
            ways[way] = Way(own, (peer, PORT), (PORT + 1, PORT + 2), name)
        yield ways


def _ip(*words: str) -> None:
    try:
        done = subprocess.run(("ip", *words), capture_output=True, text=True, timeout=10.0)
        failure = done.stderr if done.returncode else ""
    except FileNotFoundError:
        failure = "no program ip (package iproute2)"
    if failure:
        text = f"'ip {' '.join(words)}' failed: {' '.join(failure.split())}; use --shaper relay"
        raise MissingPrerequisiteError(text)


@contextlib.contextmanager
def inside(namespace: str) -> Iterator[None]:
    """Move this thread into a network namespace, if one is named.

    Sockets that are opened inside and processes that are started inside stay there.
    """
    if not namespace:
        yield
        return
    library = ctypes.CDLL(None, use_errno=True)  # os.setns exists from Python 3.12 only
    with open("/proc/thread-self/ns/net") as home, open(f"/run/netns/{namespace}") as target:
        if library.setns(target.fileno(), _CLONE_NEWNET):
            text = f"cannot enter {namespace}: {os.strerror(ctypes.get_errno())}"
            raise MissingPrerequisiteError(f"{text}; use --shaper relay")
        try:
            yield
        finally:
            library.setns(home.fileno(), _CLONE_NEWNET)
