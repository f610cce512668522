# SPDX-License-Identifier: Apache-2.0

"""Run a link on this machine, and send probes over it.

A relay runs on loopback; netem runs between two network namespaces.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from cloudrc.base.errors import (
    CloudrcError,
    InvalidRunError,
    MissingPrerequisiteError,
    RejectedError,
    TimedOutError,
)
from cloudrc.config.resolved import ResolvedExperiment, dump
from cloudrc.flight.local.children import start_process
from cloudrc.flight.local.places import ROUTE_FILE, link_words
from cloudrc.flight.machine import end_process
from cloudrc.flight.pod.netem_tools import run_tool
from cloudrc.flight.pod.realtime import bind, free_ports, show_address, split_address
from cloudrc.link.follow import make_folder
from cloudrc.link.state import STATE_FILE, from_text
from cloudrc.link.streams import Stream
from cloudrc.link.verify.judge import Measurement
from cloudrc.link.verify.probe import ProbeEnd, send_probes
from cloudrc.wire.tunnel.codec import Kind

START_LIMIT = 90.0  # for the processes of both directions to start, on a slow disk [s]
LOOPBACK, DEVICE = "127.0.0.1", "tunnel"
HOSTS = {"uplink": "10.79.7.1", "downlink": "10.79.7.2"}  # senders, with netem
WAYS = {
    "uplink": ("world", "cloud", Kind.TELEMETRY),
    "downlink": ("cloud", "world", Kind.COMMAND),
}
"""Direction -> sender, receiver, and the kind of datagram that the sender sends."""
_CLONE_NEWNET = 0x40000000  # linux include/uapi/linux/sched.h


@dataclass(slots=True)
class Way:
    """One direction of a link under test, with the socket of its probes and its shaper process."""

    own: socket.socket  # sends the probes of this direction, receives those of the other
    ports: list[int]  # port at which a relay receives, and metrics port
    namespace: str  # network namespace; "" for the namespace of this process
    peer: tuple[str, int]  # address of the other direction's socket
    folder: Path
    process: subprocess.Popen[bytes] | None = None


def measure(ways: Mapping[str, Way], plans: Mapping[str, Measurement]) -> dict[str, Stream]:
    """Send all probes over a running link; return what the probes measured in each direction."""
    since_wall_ns, ends = time.time_ns() - time.monotonic_ns(), []
    for name, way in ways.items():
        route = split_address((way.folder / ROUTE_FILE).read_text())
        origin_ns = from_text((way.folder / STATE_FILE).read_text()).origin_ns + since_wall_ns
        ends.append(ProbeEnd(way.own, route, plans[name], origin_ns))
    return dict(zip(ways, send_probes(ends), strict=True))


@contextlib.contextmanager
def run_link(experiment: ResolvedExperiment, shaper: str) -> Iterator[dict[str, Way]]:
    """Run both directions of a link during a `with` block; yield a mapping: direction -> `Way`.

    The relay runs on loopback; netem runs in two network namespaces.

    Raises:
        CloudrcError: If a process of the link ends early or starts too slowly.
    """
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="cloudrc-verify-")))
        (folder / "config.yaml").write_text(dump(experiment), encoding="utf-8")
        make_folder(folder, experiment.link_values)
        names, hosts = dict.fromkeys(WAYS, ""), dict.fromkeys(WAYS, LOOPBACK)
        if shaper == "netem":
            names, hosts = stack.enter_context(_namespaces()), HOSTS
        own, ways = dict[str, socket.socket](), dict[str, Way]()
        for name in WAYS:
            with inside(names[name]):
                own[name] = stack.enter_context(bind((hosts[name], 0)))
        for name, far in zip(WAYS, reversed(own.values()), strict=True):
            ports, peer = free_ports(2), far.getsockname()
            way = ways[name] = Way(own[name], ports, names[name], peer, folder / name)
            way.process = _start(name, way, shaper)
            stack.callback(end_process, way.process)
        deadline = time.monotonic() + START_LIMIT
        while not all((way.folder / ROUTE_FILE).exists() for way in ways.values()):
            for name, way in ways.items():
                if way.process and (code := way.process.poll()) is not None:
                    raise _ended(name, code, (way.folder / "log").read_text(errors="replace"))
            if time.monotonic() > deadline:
                raise TimedOutError(f"the link was not up within {START_LIMIT:g} s; try again")
            time.sleep(0.02)
        yield ways


def _start(name: str, way: Way, shaper: str) -> subprocess.Popen[bytes]:
    relay, pages = (f"{LOOPBACK}:{port}" for port in way.ports)
    options: dict[str, object] = {"listen": relay, "metrics": pages, "mode": shaper}
    options |= {"config": way.folder.parent / "config.yaml", "peer": show_address(way.peer)}
    words = link_words(way.folder.parent, name)
    with (way.folder / "log").open("wb") as log, inside(way.namespace):
        return start_process(words, options, log, log)


def _ended(name: str, code: int, log: str) -> CloudrcError:
    last = (log.strip().splitlines() or ["it left no message"])[-1]
    text = f"the {name} is not shaped: {last.removeprefix('cloudrc: error: ')}"
    known = {one.exit_code: one for one in (RejectedError, MissingPrerequisiteError, TimedOutError)}
    if code in known:
        return known[code](text)
    return InvalidRunError(f"{text} (exit code {code})")


@contextlib.contextmanager
def _namespaces() -> Iterator[dict[str, str]]:
    """Make two network namespaces with a veth pair between them; yield direction -> namespace."""
    if os.geteuid() != 0:
        raise MissingPrerequisiteError(
            "netem is verified between two network namespaces, which needs root; run this as root,"
            " or verify the relay (--shaper relay)"
        )
    names = {way: f"cloudrc-{way}-{os.getpid()}" for way in HOSTS}
    near, far = names.values()
    commands = [f"-n {near} link add {DEVICE} type veth peer {DEVICE} netns {far}"]
    for way, name in names.items():
        commands.append(f"-n {name} addr add {HOSTS[way]}/24 dev {DEVICE}")
        commands += [f"-n {name} link set {device} up" for device in ("lo", DEVICE)]
    with contextlib.ExitStack() as stack:
        for name in names.values():
            run_tool(("ip", "netns", "add", name))
            stack.callback(run_tool, ("ip", "netns", "del", name))
        for command in commands:
            run_tool(("ip", *command.split()))
        yield names


@contextlib.contextmanager
def inside(namespace: str) -> Iterator[None]:
    """Move this thread into a network namespace while the block runs; "" changes nothing.

    Sockets and processes that the block makes stay in the namespace after the block.
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
