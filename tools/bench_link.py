"""`make bench-link`: compare the relay with its model, and with a program in C.

Numbered datagrams go through a relay. The kernel stamps each datagram when it leaves and when it
arrives (wall clock), so late wakes of Python have no effect. Close other programs first, because
they delay the relay. Relay and C program run in turns; the C program shows how late any program
wakes on this machine. Exit codes: 0 all limits were kept, 1 a limit was exceeded, 3 no C compiler.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cloudrc.assembly import link_profile
from cloudrc.cli.output import table
from cloudrc.config.load import load_experiment
from cloudrc.config.shipped import names
from cloudrc.drivers.realtime import free_ports
from cloudrc.errors import CloudrcError, MissingPrerequisiteError
from cloudrc.link.model import LinkDirection
from cloudrc.link.profile import DirectionProfile
from cloudrc.tunnel.codec import Kind, encode_header

Address: TypeAlias = tuple[str, int]
Array: TypeAlias = NDArray[np.float64]
Link: TypeAlias = dict[str, object]
"""Section `link` of an experiment."""

DELAY = 0.020
"""Delay of the link whose release errors are measured [s]."""
SIZE = 172
"""Length of a datagram, about that of telemetry [bytes]."""
EPOCH, SEED = 1, 1
TIE_NS = 5_000
"""If two datagrams are due within this time [ns], their order is not checked."""
# Source: Linux, include/uapi/asm-generic/socket.h, linux/net_tstamp.h, linux/errqueue.h.
_SO_TIMESTAMPNS, _SO_TIMESTAMPING, _IP_RECVERR = 35, 37, 11
_TX_SOFTWARE, _SOFTWARE, _ID, _STAMP_ONLY = 1 << 1, 1 << 4, 1 << 7, 1 << 11


class Way(NamedTuple):
    """One direction of a link: datagrams leave at `source`, go to `target` and arrive at `sink`."""

    uplink: bool
    target: Address
    sink: Address
    source: Address


@dataclass
class Flow:
    """Times of sending and arrival by number of the datagram [ns, wall clock]."""

    uplink: bool
    sent: dict[int, int] = field(default_factory=dict)
    arrived: list[tuple[int, int]] = field(default_factory=list)


class Judged(NamedTuple):
    """Comparison of a flow with the model."""

    errors: Array  # measured minus modelled delays of all that arrived, copies included [s]
    wrongly_lost: int
    wrongly_arrived: int
    swapped: int


class Line(NamedTuple):
    """One line of the result table."""

    what: str
    asked: str
    measured: str
    held: bool


@contextmanager
def run_relay(folder: Path, link: Link, *, fifo: bool) -> Iterator[list[Way]]:
    """Run `cloudrc relay` for a link; yield uplink and downlink once it runs."""
    world_side, cloud_side, world, cloud = (("127.0.0.1", port) for port in free_ports(4))
    places = {"world-side": world_side, "cloud-side": cloud_side, "world": world, "cloud": cloud}
    words = [f"--{name}={host}:{port}" for name, (host, port) in places.items()]
    words += [f"--config={_write(folder, link)}", "--feed", *(["--fifo"] if fifo else [])]
    command, pipe = [sys.executable, "-m", "cloudrc", "relay", *words], subprocess.PIPE
    process = subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True)
    try:
        assert process.stdout is not None
        process.stdout.readline()
        yield [Way(True, world_side, cloud, world), Way(False, cloud_side, world, cloud)]
    finally:
        process.terminate()
        process.communicate(timeout=10)


def main() -> int:
    """Measure, print the results and return the exit code."""
    parser = argparse.ArgumentParser(prog="make bench-link", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a tenth of the time; for a look")
    parser.add_argument("-o", "--output", choices=("table", "json"), default="table")
    options = parser.parse_args()
    rounds, duration, minute = (2, 3.0, 6.0) if options.quick else (5, 20.0, 60.0)
    try:
        with TemporaryDirectory(prefix="bench-link-") as name:
            lines = releases(Path(name), rounds, duration) + profiles(Path(name), minute)
    except CloudrcError as error:
        print(f"bench-link: {error}", file=sys.stderr)
        return error.exit_code
    if options.output == "json":
        print(json.dumps({"lines": [line._asdict() for line in lines]}))
    else:
        system = f"Linux {platform.release()}, {os.cpu_count()} CPUs, load {os.getloadavg()[0]:.1f}"
        rows = [(*line[:3], "" if line.held else "MISSED") for line in lines]
        print(table([(system, "asked", "measured", ""), *rows]))
    return 0 if all(line.held for line in lines) else 1


def releases(folder: Path, rounds: int, duration: float) -> list[Line]:
    """Alternately measure how late the relay sends at 1 kHz and how late the C program wakes.

    Both use SCHED_FIFO if this user is allowed to. Each measurement takes `duration` [s].

    Raises:
        MissingPrerequisiteError: If there is no C compiler.
    """
    if shutil.which("cc") is None:
        raise MissingPrerequisiteError(
            "bench-link compiles a program in C and finds no 'cc'; apt-get install gcc"
        )
    program, source = folder / "wake_lateness", Path(__file__).with_name("wake_lateness.c")
    subprocess.run(["cc", "-O2", "-o", str(program), str(source)], check=True)
    link: Link = {"profile": "ideal", "uplink": {"delay_ms": DELAY * 1e3}}
    fifo = fifo_allowed()
    command = [*(("chrt", "-f", "10") if fifo else ()), str(program), str(round(1000 * duration))]
    wakes, errors = list[Array](), list[Array]()
    for _ in range(rounds):
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        wakes.append(np.array(done.stdout.split(), dtype=float) * 1e-9)
        with run_relay(folder, link, fifo=fifo) as ways:
            (flow,) = run_flow(ways[:1], 1000.0, duration, 2 * DELAY)
        errors.append(judge(flow, DirectionProfile(DELAY), min(flow.sent.values())).errors)

    def quantile(values: list[Array], share: float) -> float:
        """Return the median of the quantiles of all rounds [us]."""
        return 1e6 * float(np.median([np.quantile(one, share) for one in values]))

    p50, p99, wake = quantile(errors, 0.5), quantile(errors, 0.99), quantile(wakes, 0.99)
    early, how = sum(int((one < 0).sum()) for one in errors), "SCHED_FIFO" if fifo else "normal"
    return [
        Line(f"release error p50, 1 kHz, {how}", "<= 60 us", f"{p50:.1f} us", p50 <= 60),
        Line("release error p99 / C clock_nanosleep p99", "<= 1.5",
             f"{p99 / wake:.2f} ({p99:.0f} us / {wake:.0f} us)", p99 <= 1.5 * wake),
        Line("released early", "0", f"{early} of {sum(map(len, errors))}", early == 0),
    ]  # fmt: skip


def profiles(folder: Path, seconds: float) -> list[Line]:
    """Measure all shipped profiles at the same time, for `seconds` [s]; compare with the model."""
    judged = measure_profiles(folder, names("profile"), seconds)
    every = np.concatenate([one.errors for one in judged.values()])
    wrong = sum(one.wrongly_lost + one.wrongly_arrived for one in judged.values())
    swapped, early = sum(one.swapped for one in judged.values()), int((every < 0).sum())
    (mean, biased), (spread, noisy) = (
        max((1e3 * float(abs(function(one.errors))), name) for name, one in judged.items())
        for function in (np.mean, np.std)
    )
    return [
        Line("measured minus drawn delay, mean, worst profile", "<= 0.3 ms",
             f"{mean:.3f} ms ({biased})", mean <= 0.3),
        Line("the same, deviation, worst profile", "<= 0.5 ms",
             f"{spread:.3f} ms ({noisy})", spread <= 0.5),
        Line("lost or arrived, not as drawn", "0", f"{wrong} of {every.size}", not wrong),
        Line("out of the order drawn (by > 5 us)", "0", f"{swapped}", swapped == 0),
        Line("released early, profiles", "0", f"{early} of {every.size}", early == 0),
    ]  # fmt: skip


def measure_profiles(folder: Path, chosen: Iterable[str], duration: float) -> dict[str, Judged]:
    """Send through several profiles at once, in both directions at 100 Hz, for `duration` [s].

    Returns:
        Name and direction of a profile -> comparison with the model.
    """
    fifo, links = fifo_allowed(), {name: Link(profile=name) for name in chosen}
    with ExitStack() as stack:
        ways = [stack.enter_context(run_relay(folder, link, fifo=fifo)) for link in links.values()]
        # When all senders run: the start of one takes 0.6 s of CPU time from the others.
        begin = time.monotonic() + 0.6 * (len(links) + 1)
        with ProcessPoolExecutor(len(ways), mp_context=get_context("spawn")) as pool:
            tasks = [(each, duration, begin) for each in ways]
            flows = dict(zip(links, pool.map(_send, tasks), strict=True))
    judged = {}
    for name, link in links.items():
        experiment = load_experiment(str(_write(folder, link)))
        origin_ns = min(min(flow.sent.values()) for flow in flows[name])
        for flow, way in zip(flows[name], ("uplink", "downlink"), strict=True):
            profile = link_profile(getattr(experiment, way))
            judged[f"{name} {way}"] = judge(flow, profile, origin_ns)
    return judged


def fifo_allowed() -> bool:
    """Check whether this user may use SCHED_FIFO."""
    if shutil.which("chrt") is None:
        return False
    done = subprocess.run(["chrt", "-f", "10", "true"], capture_output=True, check=False)
    return done.returncode == 0


def run_flow(
    ways: Sequence[Way], rate: float, duration: float, tail: float, begin: float = 0.0
) -> list[Flow]:
    """Send in one or two directions, each at `rate` [1/s] for `duration` [s], and receive.

    Receiving ends `tail` [s] after sending. Sending begins at `begin` [s], monotonic clock.
    """
    flows = [Flow(way.uplink) for way in ways]
    addresses = {address for way in ways for address in (way.source, way.sink)}
    with ExitStack() as opened:
        ends = {address: opened.enter_context(_open(address)) for address in addresses}

        def drain() -> None:
            for way, flow in zip(ways, flows, strict=True):
                _drain(ends[way.sink], ends[way.source], flow)

        period_ns = round(1e9 / rate)
        start_ns = max(time.monotonic_ns() + 10_000_000, round(begin * 1e9))
        for number in range(round(rate * duration)):
            for turn, way in enumerate(ways):
                # The first datagram starts the link's time. The others avoid whole periods, at
                # which a trace may change while the datagram is on its way to the relay.
                shift_ns = period_ns // 4 if number or turn else 0
                due_ns = start_ns + number * period_ns + turn * period_ns // len(ways) + shift_ns
                time.sleep(max(0.0, (due_ns - time.monotonic_ns()) * 1e-9))
                header = encode_header(_kind(way.uplink), int(not way.uplink), EPOCH, number)
                ends[way.source].sendto(header.ljust(SIZE, b"\0"), way.target)
            drain()
        until = time.monotonic() + tail
        while time.monotonic() < until:
            time.sleep(0.02)
            drain()
    return flows


def judge(flow: Flow, profile: DirectionProfile, origin_ns: int) -> Judged:
    """Compare a flow with the model; the first datagram reached the relay at `origin_ns` [ns]."""
    model = LinkDirection(profile, SEED, flow.uplink, origin_ns)
    due: dict[int, list[int]] = {}
    for number in sorted(flow.sent):
        releases = model.send(EPOCH, _kind(flow.uplink), number, SIZE, flow.sent[number])
        due[number] = sorted(releases, reverse=True)
    errors, order, too_many = [], [], 0
    for at_ns, number in flow.arrived:
        if due[number]:
            order.append(due[number].pop())
            errors.append(at_ns - order[-1])
        else:
            too_many += 1
    swapped = sum(a > b + TIE_NS for a, b in pairwise(order))
    missing = sum(map(len, due.values()))
    return Judged(np.array(errors, dtype=float) * 1e-9, missing, too_many, swapped)


def _send(task: tuple[list[Way], float, float]) -> list[Flow]:
    ways, duration, begin = task
    return run_flow(ways, 100.0, duration, 1.2, begin)


def _write(folder: Path, link: Link) -> Path:
    path = folder / f"{link.get('profile', 'link')}-{len(list(folder.iterdir()))}.yaml"
    world = {"mission": "hover", "world": {"scene": "empty"}}
    path.write_text(json.dumps({"seed": SEED, **world, "link": link}))
    return path


def _kind(uplink: bool) -> Kind:
    return Kind.TELEMETRY if uplink else Kind.COMMAND


def _open(address: Address) -> socket.socket:
    one = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
    one.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
    flags = _TX_SOFTWARE | _SOFTWARE | _ID | _STAMP_ONLY
    one.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPING, flags)
    one.setblocking(False)
    one.bind(address)
    return one


def _drain(sink: socket.socket, source: socket.socket, flow: Flow) -> None:
    with suppress(BlockingIOError):
        while True:
            data, ancillary, _, _ = sink.recvmsg(SIZE, 512)
            stamp = next(value for _, kind, value in ancillary if kind == _SO_TIMESTAMPNS)
            flow.arrived.append((_stamp(stamp), int.from_bytes(data[8:16], "little")))
    with suppress(BlockingIOError):
        while True:
            _, ancillary, _, _ = source.recvmsg(0, 512, socket.MSG_ERRQUEUE)
            by_kind = {(level, kind): data for level, kind, data in ancillary}
            error = by_kind[socket.IPPROTO_IP, _IP_RECVERR]
            number = int.from_bytes(error[12:16], sys.byteorder)
            flow.sent[number] = _stamp(by_kind[socket.SOL_SOCKET, _SO_TIMESTAMPING][:16])


def _stamp(data: bytes) -> int:
    seconds, rest = memoryview(data).cast("l")
    return int(seconds * 1_000_000_000 + rest)


if __name__ == "__main__":
    sys.exit(main())
