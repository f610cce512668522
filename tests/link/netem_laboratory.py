"""Two network namespaces joined by a cable, and a flow from one to the other: for real netem."""

from __future__ import annotations

import ctypes
import os
import socket
import struct
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cloudrc.cli.link_run import Programs, runner
from cloudrc.link.netem import Netem
from cloudrc.link.profile import DirectionProfile

NEAR, FAR = f"crc-near-{os.getpid()}", f"crc-far-{os.getpid()}"
NEAR_HOST, FAR_HOST = "10.79.0.1", "10.79.0.2"
DEVICE = "wire"
PEER = (FAR_HOST, 7400)
WITHIN = 0.002
"""Of medians: a slow virtual machine now and then stands still, which means would show [s]."""
_CLONE_NEWNET = 0x40000000
_SO_TIMESTAMPNS = 35  # include/uapi/asm-generic/socket.h


class UnableError(Exception):
    """This machine cannot make the laboratory."""


def sh(*words: str) -> str:
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode:
        raise UnableError(f"{' '.join(words)}: {done.stderr.strip()}")
    return done.stdout


@contextmanager
def laboratory() -> Iterator[None]:
    """Make the namespaces and the cable; raises UnableError if that or netem is impossible here."""
    if os.geteuid() != 0:
        raise UnableError("the tests of netem need root")
    try:
        for name in (NEAR, FAR):
            sh("ip", "netns", "add", name)
        sh("ip", "-n", NEAR, "link", "add", DEVICE, "type", "veth", "peer", DEVICE, "netns", FAR)
        for name, host in ((NEAR, NEAR_HOST), (FAR, FAR_HOST)):
            sh("ip", "-n", name, "addr", "add", f"{host}/24", "dev", DEVICE)
            for device in ("lo", DEVICE):
                sh("ip", "-n", name, "link", "set", device, "up")
        sh("tc", "-n", NEAR, "qdisc", "add", "dev", DEVICE, "root", "netem")
        sh("tc", "-n", NEAR, "qdisc", "del", "dev", DEVICE, "root")
        yield
    finally:
        while _programs:
            _programs.popitem()[1].close()
        for name in (NEAR, FAR):
            with suppress(UnableError):
                sh("ip", "netns", "del", name)


@contextmanager
def inside(name: str) -> Iterator[None]:
    """Be in a namespace with this thread; sockets opened there stay there."""
    library = ctypes.CDLL(None, use_errno=True)
    with open("/proc/thread-self/ns/net") as home, open(f"/run/netns/{name}") as there:
        assert library.setns(there.fileno(), _CLONE_NEWNET) == 0, os.strerror(ctypes.get_errno())
        try:
            yield
        finally:
            library.setns(home.fileno(), _CLONE_NEWNET)


_programs: dict[Path, Programs] = {}


def run_near(tables: Path) -> Programs:
    """Run tc and ip in the near namespace."""
    if tables not in _programs:
        _programs[tables] = runner(str(tables), ("ip", "netns", "exec", NEAR))
    return _programs[tables]


def netem(tables: Path, profile: DirectionProfile, origin_ns: int = 0) -> Netem:
    return Netem(
        run_near(tables),
        profile,
        origin_ns=origin_ns,
        clock=time.monotonic_ns,
        wait=time.sleep,
        tables=tables,
    )


def qdiscs() -> str:
    return sh("tc", "-n", NEAR, "qdisc", "show", "dev", DEVICE)


class Flow:
    """Numbered datagrams from near to a port of far, and when each copy arrived."""

    def __init__(self, port: int = 7400) -> None:
        self.port = port
        self.sent_ns: list[int] = []
        self.arrived: list[tuple[int, int]] = []
        with inside(NEAR):
            self._out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        with inside(FAR):
            self._in = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._in.bind((FAR_HOST, port))
        self._in.settimeout(0.1)
        self._in.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)  # when the kernel got it
        self._open = True
        self._thread = threading.Thread(target=self._receive, daemon=True)
        self._thread.start()

    def send(self, count: int, period: float = 0.01, meanwhile: Callable[[], None] = int) -> None:
        """Send so many, one per period; call `meanwhile` after each."""
        begin = time.monotonic()
        for index in range(count):
            number = len(self.sent_ns)
            self.sent_ns.append(time.time_ns())
            self._out.sendto(number.to_bytes(4, "little") + bytes(168), (FAR_HOST, self.port))
            meanwhile()
            time.sleep(max(0.0, begin + (index + 1) * period - time.monotonic()))

    def settle(self, quiet: float = 0.5) -> Flow:
        """Wait until nothing has arrived for so long, then close."""
        count = -1
        while count != len(self.arrived):
            count = len(self.arrived)
            time.sleep(quiet)
        self._open = False
        self._thread.join()
        self._out.close()
        self._in.close()
        return self

    def delays(self) -> NDArray[np.float64]:
        """One way, of each copy that arrived [s]."""
        return np.array([(at_ns - self.sent_ns[n]) * 1e-9 for n, at_ns in self.arrived])

    def numbers(self) -> list[int]:
        return [number for number, _ in self.arrived]

    def _receive(self) -> None:
        while self._open:
            with suppress(TimeoutError):
                data, notes, _, _ = self._in.recvmsg(512, 64)
                seconds, rest_ns = struct.unpack("=qq", notes[0][2])
                number = int.from_bytes(data[:4], "little")
                self.arrived.append((number, seconds * 1_000_000_000 + rest_ns))


def measure(count: int, period: float = 0.01) -> Flow:
    """Send a flow and wait for its end."""
    flow = Flow()
    flow.send(count, period)
    return flow.settle()


def told(words: str, **values: float) -> None:
    """Print a number for those who watch with -s."""
    print(words, {name: round(float(value), 5) for name, value in values.items()})


def least(error: Callable[[], float], enough: float) -> float:
    """The least of up to three errors: a machine that stands still for a while spoils one."""
    found = error()
    for _ in range(2):
        found = found if found < enough else min(found, error())
    return found


def ping() -> float:
    """Round-trip time of one ICMP echo from near to far [s]."""
    body = b"\x08\x00" + b"\x00\x00" + b"\x12\x34\x00\x01"
    total = sum(int.from_bytes(body[i : i + 2], "big") for i in range(0, len(body), 2))
    total = (total & 0xFFFF) + (total >> 16)
    body = body[:2] + (~total & 0xFFFF).to_bytes(2, "big") + body[4:]
    with inside(NEAR):
        raw = socket.socket(socket.AF_INET, socket.SOCK_RAW, socket.IPPROTO_ICMP)
    with raw:
        raw.settimeout(5.0)
        began = time.monotonic()
        raw.sendto(body, (FAR_HOST, 0))
        raw.recv(512)
        return time.monotonic() - began
