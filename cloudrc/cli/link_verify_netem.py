"""Two network namespaces joined by a cable, in which netem is verified as between two pods.

    [world's namespace] tunnel ======= tunnel [cloud's namespace]

They live as long as the test. Needs root; nothing outside them is touched.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import socket
import subprocess
from collections.abc import Iterator

from cloudrc.cli.link_processes import LOOPBACK, WAYS, Place
from cloudrc.cli.link_verify_run import Bank
from cloudrc.errors import MissingPrerequisiteError

DEVICE = "tunnel"
PORT, METRICS_PORT = 7400, 9102
HOSTS = {"uplink": "10.79.7.1", "downlink": "10.79.7.2"}
"""Addresses of the ends, by the direction that they send."""
_CLONE_NEWNET = 0x40000000  # linux include/uapi/linux/sched.h


@contextlib.contextmanager
def banks_of_namespaces() -> Iterator[dict[str, Bank]]:
    """Make the namespaces, and open a socket in each.

    Raises:
        MissingPrerequisiteError: If this user may not, or ip is missing.
    """
    if os.geteuid() != 0:
        raise MissingPrerequisiteError(
            "netem is verified between two network namespaces, which takes root; run this as root,"
            " or verify the relay (--shaper relay)"
        )
    names = {way: f"cloudrc-{way}-{os.getpid()}" for way in WAYS}
    owns: list[socket.socket] = []
    try:
        _join(names)
        for way in WAYS:
            with _inside(names[way]):
                owns.append(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            owns[-1].bind((HOSTS[way], PORT))
        yield {way: Bank(own, _place(way, names[way])) for way, own in zip(WAYS, owns, strict=True)}
    finally:
        for own in owns:
            own.close()
        for name in names.values():
            with contextlib.suppress(MissingPrerequisiteError):
                _ip("netns", "del", name)


def _place(way: str, name: str) -> Place:
    other = next(one for one in WAYS if one != way)
    return Place(
        peer=(HOSTS[other], PORT),
        listen=(LOOPBACK, PORT + 1),
        metrics=(LOOPBACK, METRICS_PORT),
        inside=("ip", "netns", "exec", name),
    )


def _join(names: dict[str, str]) -> None:
    """Make both namespaces and the cable."""
    near, far = (names[way] for way in WAYS)
    for name in (near, far):
        _ip("netns", "add", name)
    _ip("-n", near, "link", "add", DEVICE, "type", "veth", "peer", DEVICE, "netns", far)
    for way, name in names.items():
        _ip("-n", name, "addr", "add", f"{HOSTS[way]}/24", "dev", DEVICE)
        for device in ("lo", DEVICE):
            _ip("-n", name, "link", "set", device, "up")


def _ip(*words: str) -> str:
    return _run("ip", *words)


def _run(*words: str) -> str:
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=10.0, check=False)
    except FileNotFoundError:
        raise MissingPrerequisiteError(
            f"no program {words[0]} (package iproute2); install it, or use --shaper relay"
        ) from None
    if done.returncode:
        raise MissingPrerequisiteError(
            f"'{' '.join(words)}' failed: {' '.join(done.stderr.split())}; use --shaper relay"
        )
    return done.stdout


@contextlib.contextmanager
def _inside(name: str) -> Iterator[None]:
    """Be in a namespace with this thread; sockets that are opened there stay there."""
    library = ctypes.CDLL(None, use_errno=True)  # os.setns is Python 3.12's
    with open("/proc/thread-self/ns/net") as home, open(f"/run/netns/{name}") as there:
        if library.setns(there.fileno(), _CLONE_NEWNET):
            raise MissingPrerequisiteError(
                f"cannot enter the namespace {name}: {os.strerror(ctypes.get_errno())}; use "
                "--shaper relay"
            )
        try:
            yield
        finally:
            library.setns(home.fileno(), _CLONE_NEWNET)
