"""How exactly relays release at 1 kHz, and how many packets a second of processor time moves."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from cloudrc.link.profile import DirectionProfile
from cloudrc.link.relay_io import Sender
from cloudrc.tunnel.codec import Kind, encode_header
from tools.bench_link.anchors import wake_lateness
from tools.bench_link.flow import SIZE, Way, run_flow
from tools.bench_link.judge import Array, judge
from tools.bench_link.relays import DELAY, Process, of_asyncio, of_c, ours

OURS, OF_C, OF_ASYNCIO, WAKE = "cloudrc relay", "C relay", "asyncio relay", "C clock_nanosleep"
RATE = 1000.0
LINK: dict[str, object] = {"profile": "ideal", "uplink": {"delay_ms": DELAY * 1e3}}
BURST = 100
SATURATING = 1e6
"""More than the sender manages [1/s]."""
AFTERWARDS = 0.5
"""For what is in flight to arrive [s]."""


@dataclass
class Releases:
    """What rounds of measurement have given.

    Attributes:
        errors: By relay, for each round: released minus due [s], shape (n,); for `WAKE` the
            lateness of waking.
        cpu: By relay: share of a core, for each round.
    """

    errors: dict[str, list[Array]] = field(default_factory=dict)
    cpu: dict[str, list[float]] = field(default_factory=dict)

    def quantile(self, name: str, share: float) -> float:
        """Take a quantile of each round, and the median over the rounds [s]."""
        return float(np.median([np.quantile(one, share) for one in self.errors[name]]))

    def early(self, name: str) -> tuple[int, int]:
        """Count those that came before they were due, and all."""
        return sum(int((one < 0).sum()) for one in self.errors[name]), sum(
            one.size for one in self.errors[name]
        )


def _makers(folder: Path, relay: Path, *, fifo: bool) -> dict[str, Callable[[], Process]]:
    flags = ("--fifo",) if fifo else ()
    return {
        OURS: partial(ours, folder, LINK, *flags),
        OF_C: partial(of_c, relay, stamps=True),
        OF_ASYNCIO: of_asyncio,
    }


def measure_releases(
    folder: Path, programs: tuple[Path, Path], rounds: int, duration: float, *, fifo: bool
) -> Releases:
    """Measure all in turns.

    Args:
        folder: For files.
        programs: The anchors.
        rounds: How often.
        duration: Of each relay in each round [s].
        fifo: Whether to run them under SCHED_FIFO.

    Returns:
        All errors.
    """
    found, (wake, relay) = Releases(), programs
    for _ in range(rounds):
        late = wake_lateness(wake, round(RATE * duration), fifo=fifo)
        found.errors.setdefault(WAKE, []).append(late)
        for name, make in _makers(folder, relay, fifo=fifo).items():
            process = make()
            if fifo:
                process.run_first()
            before, began = process.cpu(), time.monotonic()
            (flow,) = run_flow(process.ways[:1], RATE, duration, 2 * DELAY)
            cpu = (process.cpu() - before) / (time.monotonic() - began)
            process.stop()
            judged = judge(flow, DirectionProfile(DELAY), 1, min(flow.sent.values()))
            found.errors.setdefault(name, []).append(judged.errors)
            found.cpu.setdefault(name, []).append(cpu)
    return found


def measure_throughput(folder: Path, relay: Path, rounds: int, duration: float) -> dict[str, float]:
    """Offer relays more than they can take, in turns.

    Args:
        folder: For files.
        relay: The C relay.
        rounds: How often.
        duration: Of each flood [s].

    Returns:
        Most packets forwarded per second of processor time, by relay.
    """
    makers = _makers(folder, relay, fifo=False)
    best = dict.fromkeys(makers, 0.0)
    for _ in range(rounds):
        for name, make in makers.items():
            process = make()
            before = process.cpu()
            with Sink(process.ways[0]) as sink:
                flood(process.ways[0], SATURATING, duration)
                time.sleep(AFTERWARDS)
                arrived = sink.count()
            spent = process.cpu() - before
            process.stop()
            best[name] = max(best[name], arrived / max(spent, 0.01))
    return best


class Sink:
    """Counts what arrives, whether there is room for it or not."""

    def __init__(self, way: Way) -> None:
        """Listen where the way ends."""
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(way.sink)
        self._port = way.sink[1]

    def __enter__(self) -> Sink:
        """Be listening."""
        return self

    def __exit__(self, *_: object) -> None:
        """Stop listening."""
        self._socket.close()

    def count(self) -> int:
        """Say how many have come: those that wait are read, the others the kernel has counted."""
        waiting = 0
        self._socket.setblocking(False)
        try:
            while self._socket.recv(SIZE):
                waiting += 1
        except BlockingIOError:
            pass
        return waiting + self._dropped()

    def _dropped(self) -> int:
        """Ask the kernel how many it had no room for: /proc/net/udp, last column.

        Source: Linux, net/ipv4/udp.c, udp4_format_sock.
        """
        for line in Path("/proc/net/udp").read_text().splitlines()[1:]:
            fields = line.split()
            if int(fields[1].rpartition(":")[2], 16) == self._port:
                return int(fields[-1])
        return 0


def flood(way: Way, rate: float, duration: float, first: int = 0) -> int:
    """Send in bursts of 100, at most `rate` [1/s], for `duration` [s]; gives how many."""
    sent, start, period = 0, time.monotonic(), BURST / rate
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as source:
        sender = Sender(source, BURST, SIZE)
        while (now := time.monotonic()) < start + duration:
            if now < start + sent // BURST * period:
                time.sleep(0.0002)
                continue
            numbers = range(first + sent, first + sent + BURST)
            headers = [encode_header(Kind.TELEMETRY, 0, 1, number) for number in numbers]
            sent += sender.send([header.ljust(SIZE, b"\0") for header in headers], way.target)
    return sent
