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
from dataclasses import dataclass, replace
from pathlib import Path

from cloudrc.assembly import link_profile
from cloudrc.cli.link_run import inspect_network
from cloudrc.cli.link_verify_report import (
    NOT_JUDGED,
    WAYS,
    Report,
    fetch,
    make_report,
    on_correlation,
)
from cloudrc.cluster.client import end_process
from cloudrc.config.document import write_yaml
from cloudrc.config.load import ResolvedExperiment, dump
from cloudrc.config.schema import Profile
from cloudrc.drivers.machine import interpreter
from cloudrc.drivers.process import PARENT
from cloudrc.drivers.realtime import bind, free_ports, parse
from cloudrc.errors import BadInputError, InvalidRunError, MissingPrerequisiteError, TimedOutError
from cloudrc.link.sidecar import Told, read_told
from cloudrc.link.state import STATE_FILE, from_text
from cloudrc.link.tc import check
from cloudrc.link.verify.causes import Findings, read_evidence, read_metrics
from cloudrc.link.verify.expect import Flow, Plan
from cloudrc.link.verify.judge import judge, look_twice, verdict_of
from cloudrc.link.verify.probe import PROBE, ProbeEnd, plan_probes, send_probes
from cloudrc.tunnel.codec import SIZES

START_LIMIT = 90.0
"""Longest time for both processes to start, which a slow disk needs, and to stop [s]."""
COUNTS_WAIT = 1.3
"""Time until the processes have counted the last probe [s]; they do so once a second."""
LOOPBACK, DEVICE, PORT = "127.0.0.1", "tunnel", 7400
HOSTS = {"uplink": "10.79.7.1", "downlink": "10.79.7.2"}
"""Direction -> address of its sending end, in that end's namespace."""
_CLONE_NEWNET = 0x40000000  # linux include/uapi/linux/sched.h


@dataclass(slots=True)
class Way:
    """One direction of a link under test: its probes' socket, the shaper's files and process."""

    own: socket.socket
    peer: tuple[str, int]
    ports: tuple[int, int]  # where a relay receives, and where the process serves its pages
    namespace: str = ""  # of the network; "" for this process's
    folder: Path = Path()
    process: subprocess.Popen[bytes] | None = None

    def get(self, page: str) -> str:
        """Fetch a page of the process; "" without an answer."""
        with inside(self.namespace):
            return fetch(f"http://{LOOPBACK}:{self.ports[1]}/{page}")


def verify(
    title: str,
    experiment: ResolvedExperiment,
    shaper: str,
    seconds: float | None,
    tell: Callable[[str], None],
    applied: Profile | None = None,
    meddle: Callable[[Mapping[str, Way]], None] = lambda ways: None,
) -> Report:
    """Probe a link for `seconds` [s], None for as long as needed; look twice at what is off.

    Tests inject faults: by another profile `applied`, and by a function that gets the running link.
    """
    tell("planning the probes")
    plans, found, notes = make_plans(experiment, seconds, shaper), dict[str, Findings](), []
    for look in ("sending probes", "looking again at what is off"):
        tell(f"{look}: {max(plan.sent[-1] for plan in plans.values()):.0f} s")
        with run_link(experiment, shaper, applied) as ways:
            meddle(ways)
            now = probe_link(ways, plans)
        rows = {way: look_twice(found.get(way, now[way]).rows, now[way].rows) for way in now}
        found = {way: now[way]._replace(rows=rows[way]) for way in now}
        if "off" not in {verdict_of(one.rows) for one in found.values()}:
            break
    tell("")
    for way, plan in plans.items():
        if shaper == "netem" and plan.profile.correlation and plan.profile.jitter:
            notes.append(on_correlation(way, plan.profile.correlation))
        if plan.profile.rate and not plan.train:
            notes.append(f"{way}: rate {NOT_JUDGED}: this machine itself is hardly faster")
    probes = {
        way: f"{len(plan.sent)} probes of {plan.flow.size} bytes" for way, plan in plans.items()
    }
    return make_report(title, found, probes, notes)


def make_plans(
    experiment: ResolvedExperiment, seconds: float | None, shaper: str
) -> dict[str, Plan]:
    """Plan probes of the size of datagrams for `seconds` [s]; None: as long as needed.

    Raises:
        BadInputError: If netem cannot realise the profile; names the direction.
    """
    plans = {}
    for way, (_, _, kind) in WAYS.items():
        flow = Flow(experiment.seed, way == "uplink", PROBE, SIZES[kind])
        profile = link_profile(getattr(experiment, way))
        try:
            if shaper == "netem":
                check(profile)
        except BadInputError as error:
            raise BadInputError(_advise(f"{way}: {error}")) from None
        plans[way] = plan_probes(profile, flow, seconds, drawn=shaper == "netem")
    return plans


def probe_link(ways: Mapping[str, Way], plans: Mapping[str, Plan]) -> dict[str, Findings]:
    """Send all probes over a running link and judge them."""
    since_wall_ns, ends, found, states = time.time_ns() - time.monotonic_ns(), [], {}, {}
    for name, way in ways.items():
        text = (way.folder / STATE_FILE).read_text(encoding="utf-8")
        state = states[name] = from_text(text)
        route = parse((way.folder / "route").read_text(encoding="ascii"))
        ends.append(ProbeEnd(way.own, route, plans[name], (state.origin_ns or 0) + since_wall_ns))
    streams = send_probes(ends)
    time.sleep(COUNTS_WAIT)
    for (name, way), stream in zip(ways.items(), streams, strict=True):
        plan, page, metrics = plans[name], way.get("link.json"), read_metrics(way.get("metrics"))
        with inside(way.namespace):  # a process that hangs says nothing, the kernel does
            near = inspect_network(way.peer[0])
        told = Told(states[name].shaper, states[name].reason, None)
        told = replace(read_told(page) if page else told, near=near)
        known = read_evidence(told, metrics, len(stream.sent))
        rows = judge(plan, stream, plan.expected(stream), plan.applied(known.applied))
        found[name] = Findings(rows, known)
    return found


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
        (folder / "config.yaml").write_text(dump(experiment), encoding="utf-8")
        (folder / "profile.yaml").write_text(text, encoding="utf-8")
        for name, way in ways.items():
            way.folder = folder / name
            way.folder.mkdir()
            way.process = _start(name, way, shaper)
            stack.callback(end_process, way.process)
        deadline = time.monotonic() + START_LIMIT
        while not all((way.folder / "route").exists() for way in ways.values()):
            for name, way in ways.items():
                if way.process and (code := way.process.poll()) is not None:
                    _raise(name, code, (way.folder / "log").read_text(errors="replace"))
            if time.monotonic() > deadline:
                raise TimedOutError(f"the link was not up within {START_LIMIT:g} s; try again")
            time.sleep(0.02)
        yield ways


def _start(name: str, way: Way, shaper: str) -> subprocess.Popen[bytes]:
    relay, pages = (f"{LOOPBACK}:{port}" for port in way.ports)
    words = [f"--peer={way.peer[0]}:{way.peer[1]}", f"--listen={relay}", f"--metrics={pages}"]
    words += [f"--{file}={way.folder.parent / file}.yaml" for file in ("config", "profile")]
    words += [f"--direction={name}", f"--mode={shaper}", f"--route={way.folder / 'route'}"]
    with (way.folder / "log").open("wb") as log, inside(way.namespace):
        return subprocess.Popen(
            interpreter("-m", "cloudrc", "link", "run", *words),
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            env={**os.environ, PARENT: str(os.getpid())},
            start_new_session=True,  # Ctrl-C reaches this process alone, which stops them
        )


def _advise(text: str) -> str:
    """Replace the advice for a chart by the one for this command."""
    return text.replace("set link.mode=", "use --shaper ")


def _raise(name: str, code: int, log: str) -> None:
    last = (log.strip().splitlines() or ["it left no message"])[-1]
    words = _advise(last.removeprefix("cloudrc: error: "))
    for kind in (BadInputError, MissingPrerequisiteError, TimedOutError):
        if code == kind.exit_code:
            raise kind(f"the {name} is not shaped: {words}")
    raise InvalidRunError(f"the {name} is not shaped: its process ended with {code}: {words}")


@contextlib.contextmanager
def _open_loopback() -> Iterator[dict[str, Way]]:
    with bind((LOOPBACK, 0)) as up, bind((LOOPBACK, 0)) as down:
        pages, relays = free_ports(2, socket.SOCK_STREAM), free_ports(2)
        yield {
            "uplink": Way(up, down.getsockname(), (relays[0], pages[0])),
            "downlink": Way(down, up.getsockname(), (relays[1], pages[1])),
        }


@contextlib.contextmanager
def _open_namespaces() -> Iterator[dict[str, Way]]:
    if os.geteuid() != 0:
        raise MissingPrerequisiteError(
            "netem is verified between two network namespaces, which needs root; run this as root,"
            " or verify the relay (--shaper relay)"
        )
    names, ways = {way: f"cloudrc-{way}-{os.getpid()}" for way in HOSTS}, {}
    near, far = names.values()
    with contextlib.ExitStack() as stack:
        for name in names.values():
            _ip("netns", "add", name)
            stack.callback(_ip, "netns", "del", name)
        _ip("-n", near, "link", "add", DEVICE, "type", "veth", "peer", DEVICE, "netns", far)
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
        failure = " ".join(done.stderr.split()) if done.returncode else ""
    except FileNotFoundError:
        failure = "no program ip (package iproute2)"
    if failure:
        raise MissingPrerequisiteError(f"ip {' '.join(words)}: {failure}; use --shaper relay")


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
            raise MissingPrerequisiteError(f"cannot enter {namespace}; use --shaper relay")
        try:
            yield
        finally:
            library.setns(home.fileno(), _CLONE_NEWNET)
