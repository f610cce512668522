"""Fixtures of the link: packets over a model, a fake tc kernel, a netem laboratory, a fake sidecar.

The laboratory joins two network namespaces by a cable for tests of real netem. The sidecar's
shapers only store calls, on a clock that a test moves.
"""

from __future__ import annotations

import ctypes
import json
import os
import socket
import struct
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from cloudrc.cli.link_run import Programs
from cloudrc.errors import BadInputError, MissingPrerequisiteError
from cloudrc.link.follow import Loaded
from cloudrc.link.model import LinkDirection
from cloudrc.link.netem import Netem
from cloudrc.link.profile import DirectionProfile
from cloudrc.link.sidecar import Machine, Mode, Settings, Sidecar
from cloudrc.link.state import Change
from cloudrc.link.tc import Answer, write_tables


@pytest.fixture(scope="module")
def tables(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Make the laboratory; the value is the folder of tc's distributions."""
    folder = tmp_path_factory.mktemp("tc")
    write_tables(folder)
    try:
        with laboratory():
            yield folder
    except UnableError as error:
        pytest.exit(f"netem cannot be tested here: {error}", MissingPrerequisiteError.exit_code)


@pytest.fixture
def shaped(tables: Path) -> Iterator[Netem]:
    """Install netem without conditions."""
    netem = real_netem(tables, DirectionProfile())
    assert netem.follow_peer(FAR_PEER) == FAR_PEER
    yield netem
    netem.close()


MS = 1_000_000
PERIOD_NS = 10 * MS
TELEMETRY = 3
SIZE = 172


def link(profile: DirectionProfile, seed: int = 1, uplink: bool = True) -> LinkDirection:
    return LinkDirection(profile, seed, uplink)


def flow(
    profile: DirectionProfile, count: int, seed: int = 1, period_ns: int = PERIOD_NS
) -> list[tuple[int, ...]]:
    """Return the delays [ns] of each packet's copies, one packet per period."""
    direction = link(profile, seed)
    return [
        tuple(release - n * period_ns for release in releases)
        for n in range(count)
        for releases in [direction.send(1, TELEMETRY, n, SIZE, n * period_ns)]
    ]


def delays(profile: DirectionProfile, count: int, seed: int = 1) -> NDArray[np.float64]:
    """Return the delays [s] of `count` packets, none lost or duplicated."""
    return np.array([delay * 1e-9 for (delay,) in flow(profile, count, seed)])


def losses(profile: DirectionProfile, count: int, seed: int = 1) -> NDArray[np.bool_]:
    """Return True for each lost packet."""
    return np.array([not copies for copies in flow(profile, count, seed)])


def bursts(lost: NDArray[np.bool_]) -> list[int]:
    """Return the lengths of the runs of True."""
    runs, length = [], 0
    for one in [*lost.tolist(), False]:
        if one:
            length += 1
        elif length:
            runs.append(length)
            length = 0
    return runs


def bind_loopback(port: int = 0) -> socket.socket:
    """Open a UDP socket on 127.0.0.1; port 0 lets the kernel choose."""
    bound = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    bound.bind(("127.0.0.1", port))
    return bound


PEER = ("10.244.0.7", 7400)
UNKNOWN = Answer(2, "", "Error: Specified qdisc kind is unknown.\n")
NO_QDISC = Answer(2, "", "Error: No such file or directory.\n")
NO_CLASSIFIER = Answer(
    2, "", "Error: TC classifier not found.\nWe have an error talking to the kernel\n"
)


class Kernel:
    """An interface with its qdiscs and filters."""

    def __init__(self, *lacks: str) -> None:
        self.lacks = lacks
        self.held = 4
        self.said: list[str] = []
        self.clamps: dict[str, object] = {}
        self._clear()

    def run(self, words: Sequence[str]) -> Answer:
        line = " ".join(words)
        if not line.startswith(("tc -s -j", "ip")):
            self.said.append(line.removeprefix("tc ").replace("dev eth0 ", ""))
        match words:
            case ["ip", *_]:
                return Answer(0, '[{"dst":"10.244.0.7","dev":"eth0","flags":[]}]', "")
            case ["tc", "-s", "-j", "qdisc", *_]:
                return Answer(0, json.dumps(self.qdiscs()), "")
            case ["tc", "-s", "-j", "filter", *_]:
                entries = [{"pref": number, "kind": "u32"} for number in self.filters]
                return Answer(0, json.dumps(entries * 2), "")
            case ["tc", "qdisc", "del", *_]:
                self._clear()
            case ["tc", "qdisc", verb, *rest]:
                kind = "netem" if "netem" in rest else "prio"
                if kind in self.lacks:
                    return UNKNOWN
                if kind == "prio":
                    self.root = {"kind": "prio", "handle": "7400:", "root": True}
                else:
                    if verb == "change" and self.netem is None:
                        return NO_QDISC
                    assert (verb == "add") is (self.netem is None)
                    self.netem = list(rest[rest.index("netem") + 1 :])
            case ["tc", "filter", "add", "dev", _, "parent", _, "pref", number, *rest]:
                if rest[2] in self.lacks:
                    return NO_CLASSIFIER
                assert int(number) not in self.filters
                self.filters[int(number)] = " ".join(rest)
            case ["tc", "filter", "del", *_, number]:
                del self.filters[int(number)]
        return Answer(0, "", "")

    def qdiscs(self) -> list[dict[str, object]]:
        leaf = {"kind": "netem", "handle": "7401:", "packets": 90, "drops": 10}
        leaf["qlen"] = self.held
        leaf["options"] = {**listing(self.netem or []), **self.clamps}
        return [self.root, *([leaf] if self.netem is not None else [])]

    def _clear(self) -> None:
        self.root = {"kind": "noqueue", "handle": "0:", "root": True}
        self.netem: list[str] | None = None
        self.filters: dict[int, str] = {}


def listing(words: Sequence[str]) -> dict[str, object]:
    """Return the "options" that `tc -j qdisc show` prints for the words of a netem command."""
    text = " ".join(words)
    found: dict[str, object] = {"limit": int(words[words.index("limit") + 1]) if words else 1000}
    for name, key, unit in (("delay", "delay", 1e-6), ("duplicate", "duplicate", 0.01),
                            ("corrupt", "corrupt", 0.01), ("random", "loss-random", 0.01),
                            ("rate", "rate", 0.125)):  # fmt: skip
        if name in words:
            number = float(text.split(f"{name} ")[1].split(" ")[0].rstrip("usbitg%"))
            scale = unit * (1e9 if f"{name} 100gbit" in text else 1.0)
            found[key] = {"loss" if key == "loss-random" else key: number * scale}
    return found


class Clock:
    now_ns = 0

    def __call__(self) -> int:
        return self.now_ns

    def wait(self, duration: float) -> None:
        self.now_ns += round(duration * 1e9)


def netem(
    kernel: Kernel,
    profile: DirectionProfile,
    clock: Clock | None = None,
    log: Callable[[str], None] = lambda line: None,
) -> Netem:
    clock = clock or Clock()
    return Netem(kernel.run, profile, origin_ns=0, clock=clock, wait=clock.wait, log=log)


NEAR, FAR = f"crc-near-{os.getpid()}", f"crc-far-{os.getpid()}"
NEAR_HOST, FAR_HOST = "10.79.0.1", "10.79.0.2"
DEVICE = "wire"
FAR_PEER = (FAR_HOST, 7400)
WITHIN = 0.002
"""Tolerance of medians [s]; means would show the stalls of a slow virtual machine."""
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
    """Make the namespaces and the cable; raise UnableError if that or netem is impossible here."""
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
    """Move this thread to a namespace; sockets opened in it stay there."""
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
        _programs[tables] = Programs(str(tables), ("ip", "netns", "exec", NEAR))
    return _programs[tables]


def real_netem(tables: Path, profile: DirectionProfile, origin_ns: int = 0) -> Netem:
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
    """Numbered datagrams from near to a port of far, with the arrival of each copy."""

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
        self._in.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)  # the kernel's time of arrival
        self._open = True
        self._thread = threading.Thread(target=self._receive, daemon=True)
        self._thread.start()

    def send(self, count: int, period: float = 0.01, meanwhile: Callable[[], None] = int) -> None:
        """Send `count` datagrams, one per period; call `meanwhile` after each."""
        begin = time.monotonic()
        for index in range(count):
            number = len(self.sent_ns)
            self.sent_ns.append(time.time_ns())
            self._out.sendto(number.to_bytes(4, "little") + bytes(168), (FAR_HOST, self.port))
            meanwhile()
            time.sleep(max(0.0, begin + (index + 1) * period - time.monotonic()))

    def settle(self, quiet: float = 0.5) -> Flow:
        """Wait until nothing arrives any more, then close."""
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
        """Return the one-way delay of each copy that arrived [s]."""
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


def show(words: str, **values: float) -> None:
    """Print a number, which pytest shows with -s."""
    print(words, {name: round(float(value), 5) for name, value in values.items()})


def least(error: Callable[[], float], enough: float) -> float:
    """Return the smallest of up to three errors, since a stall of the machine spoils one."""
    found = error()
    for _ in range(2):
        found = found if found < enough else min(found, error())
    return found


REFUSED = BadInputError("netem cannot do delay_ms above 274000 (far); set link.mode=relay")


class Shaper:
    def __init__(self, bench: Bench, name: str, refuses: Exception | None = None) -> None:
        self.name = name
        self._bench = bench
        self._refuses = refuses

    def follow_peer(self, peer: tuple[str, int]) -> tuple[str, int]:
        if self._refuses:
            raise self._refuses
        self._bench.did.append(f"{self.name} {peer[0]}")
        return peer if self.name == "netem" else ("127.0.0.1", 7401)

    def follow_profile(self, profile: DirectionProfile, *, restart: bool = False) -> None:
        if self.name == "netem" and profile.delay == 9.0:
            raise REFUSED
        again = " from now" if restart else ""
        self._bench.did.append(f"{self.name} {profile.delay:g} s{again}")

    def step(self, timeout: float) -> None:
        assert timeout <= 0.1
        self._bench.wait(timeout)

    def counts(self) -> dict[str, int]:
        return {"forwarded": len(self._bench.did)}

    def released(self) -> dict[str, int]:
        return {"released": 1, "overflow": 0} if self.name == "relay" else {}

    def close(self) -> None:
        self._bench.did.append(f"{self.name} closes")


class Bench:
    """A sidecar whose time passes in `wait`, which runs the planned events."""

    def __init__(
        self,
        folder: Path,
        mode: Mode,
        refuses: Exception | None = None,
        may_shape: bool = True,
        profile: DirectionProfile | None = None,
    ) -> None:
        self.did: list[str] = []
        self.log: list[str] = []
        self.now_ns = 0
        self.plan: list[tuple[float, Callable[[], None]]] = []
        self.counted_ns: list[int] = []
        self.origins_ns: list[int] = []
        self.delays: list[float] = []
        self.no_netem: Exception | None = None
        self.route, self.state = folder / "route", folder / "link.json"
        machine = Machine(
            relay=lambda _, origin_ns: self.make("relay", origin_ns),
            netem=lambda asked, origin_ns: self.make(
                "netem", origin_ns, REFUSED if asked.delay == 9.0 else refuses
            ),
            may_shape=may_shape,
            try_netem=self.try_netem,
            clock=lambda: self.now_ns,
            today=lambda: "2026-01-02T03:04:05+00:00",
            wait=self.wait,
            log=self.log.append,
        )
        settings = Settings(mode, "uplink", self.route, self.state)
        loaded = Loaded(profile or DirectionProfile(), {"description": "nothing"})
        self.sidecar = Sidecar(settings, machine, loaded, self)
        self.sidecar.peer = PEER

    def make(self, name: str, origin_ns: int, refuses: Exception | None = None) -> Shaper:
        self.origins_ns.append(origin_ns)
        return Shaper(self, name, refuses)

    def try_netem(self) -> None:
        if self.no_netem:
            raise self.no_netem

    def at(self, time: float, action: Callable[[], None]) -> None:
        self.plan.append((time, action))

    def wait(self, duration: float) -> None:
        self.now_ns += round(duration * 1e9)
        for entry in [one for one in self.plan if one[0] * 1e9 <= self.now_ns]:
            self.plan.remove(entry)
            entry[1]()

    def run(self, until: float = 3.0) -> Bench:
        self.sidecar.run(lambda: self.now_ns >= until * 1e9)
        return self

    def shapes(self, shaper: str) -> None:
        self.did.append(f"metric {shaper}")

    def asked(self, delay: float) -> None:
        self.delays.append(delay)

    def counted(self, stamp_ns: int, counts: dict[str, int]) -> None:
        self.counted_ns.append(stamp_ns)

    def replace(self, delay: float, change: Change = Change()) -> None:  # noqa: B008
        values = {"description": f"{delay:g} s"}
        self.sidecar.profile = Loaded(DirectionProfile(delay), values, change)


def told(bench: Bench) -> dict[str, object]:
    found: dict[str, object] = json.loads(bench.state.read_text())
    return found
