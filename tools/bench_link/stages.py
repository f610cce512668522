"""Measure the relay, each stage beside what is asked of it and beside anchors of the same run."""

from __future__ import annotations

import json
import socket
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from itertools import groupby
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np

from cloudrc.assembly import link_profile
from cloudrc.config.load import load_experiment
from cloudrc.link.model import LinkDirection
from cloudrc.link.profile import DirectionProfile, GilbertElliott, Trace
from tools.bench_link.flow import SIZE, Array, Flow, Judged, Way, flood, judge, run_flow
from tools.bench_link.relays import DELAY, Process, of_asyncio, of_c, ours, wake_lateness

OURS, OF_C, OF_ASYNCIO, WAKE = "cloudrc relay", "C relay", "asyncio relay", "C clock_nanosleep"
SEED = 1
TRACE = "trace"
LINK: dict[str, object] = {"profile": "ideal", "uplink": {"delay_ms": DELAY * 1e3}}
Links: TypeAlias = dict[str, dict[str, object]]
"""Name -> the section `link` of an experiment file."""
TAIL = 1.2
"""Longer than any shipped delay [s]."""
START_EACH = 0.6
"""Time for a process that sends through a link to start [s]."""
MEMORY_MAX = 64 << 20
"""Limit of the memory that a flood may take [bytes]."""
FLOW_RATE, FLOW_DURATION = 200.0, 3.0
"""Of the flow before and after a flood: rate [1/s] and duration [s]."""
US, MS = 1e6, 1e3


class Line(NamedTuple):
    """One thing that was asked.

    Attributes:
        what: In words.
        asked: The bound, in words.
        measured: Likewise.
        anchor: What else was measured in the same run, to compare.
        held: Whether it is inside the bound.
    """

    what: str
    asked: str
    measured: str
    anchor: str
    held: bool


@dataclass
class Releases:
    """Release errors of all relays.

    Attributes:
        errors: By relay, for each round: released minus due [s], shape (n,); for `WAKE` the
            lateness of waking.
        cpu: By relay: share of a core, for each round.
    """

    errors: dict[str, list[Array]] = field(default_factory=dict)
    cpu: dict[str, list[float]] = field(default_factory=dict)

    def quantile(self, name: str, share: float) -> float:
        """Return the median over the rounds of a quantile [s]."""
        return float(np.median([np.quantile(one, share) for one in self.errors[name]]))


def start(name: str, folder: Path, relay: Path, *, fifo: bool) -> Process:
    """Start one of the three relays."""
    if name == OURS:
        return ours(folder, LINK, *(("--fifo",) if fifo else ()))
    process = of_c(relay) if name == OF_C else of_asyncio()
    if fifo:
        process.use_fifo()
    return process


def measure_releases(
    folder: Path, programs: tuple[Path, Path], rounds: int, duration: float, *, fifo: bool
) -> Releases:
    """Measure all relays at 1 kHz, in turns."""
    found, (wake, relay) = Releases(), programs
    for _ in range(rounds):
        late = wake_lateness(wake, round(1000 * duration), fifo=fifo)
        found.errors.setdefault(WAKE, []).append(late)
        for name in (OURS, OF_C, OF_ASYNCIO):
            process = start(name, folder, relay, fifo=fifo)
            before, began = process.cpu(), time.monotonic()
            (flow,) = run_flow(process.ways[:1], 1000.0, duration, 2 * DELAY)
            cpu = (process.cpu() - before) / (time.monotonic() - began)
            process.stop()
            judged = judge(flow, DirectionProfile(DELAY), SEED, min(flow.sent.values()))
            found.errors.setdefault(name, []).append(judged.errors)
            found.cpu.setdefault(name, []).append(cpu)
    return found


def judge_releases(found: Releases, fifo: bool) -> list[Line]:
    """Judge the release errors at 1 kHz."""
    p99 = {name: found.quantile(name, 0.99) * US for name in found.errors}
    p50 = {name: found.quantile(name, 0.5) * US for name in found.errors}
    anchor = WAKE if fifo else OF_C
    early = sum(int((one < 0).sum()) for one in found.errors[OURS])
    count = sum(one.size for one in found.errors[OURS])
    ratio, worse = p99[OURS] / p99[anchor], p99[OF_ASYNCIO] / p99[OURS]
    others = f"{OF_C} {p50[OF_C]:.0f} us, asyncio {p50[OF_ASYNCIO]:.0f} us"
    tails = f"{anchor} {p99[anchor]:.0f} us, {OF_C} {p99[OF_C]:.0f} us"
    top = {name: found.quantile(name, 0.999) * US for name in (OURS, OF_C)}
    cpu = {name: 100 * float(np.median(shares)) for name, shares in found.cpu.items()}
    how = "SCHED_FIFO" if fifo else "normal priority"
    return [
        Line(f"release error p50, 1 kHz, {how}", "<= 60 us", f"{p50[OURS]:.1f} us", others,
             p50[OURS] <= 60),
        Line(f"release error p99 / {anchor} p99", "<= 1.5", f"{ratio:.2f} ({p99[OURS]:.0f} us)",
             tails, ratio <= 1.5),
        Line("asyncio relay p99 / release error p99", ">= 20", f"{worse:.0f}",
             f"asyncio {p99[OF_ASYNCIO]:.0f} us", worse >= 20 or not fifo),
        Line("release error p99.9", "told", f"{top[OURS]:.0f} us", f"{OF_C} {top[OF_C]:.0f} us",
             True),
        Line("released early", "0", f"{early} of {count}", "", early == 0),
        Line("share of a core at 1 kHz", "told", f"{cpu[OURS]:.1f} %",
             f"{OF_C} {cpu[OF_C]:.1f} %, asyncio {cpu[OF_ASYNCIO]:.1f} %", True),
    ]  # fmt: skip


def throughput(folder: Path, relay: Path, rounds: int, duration: float) -> list[Line]:
    """Offer relays more than they can take, in turns, and judge the packets per CPU second."""
    best: dict[str, float] = {}
    for _ in range(rounds):
        for name in (OURS, OF_C, OF_ASYNCIO):
            process = start(name, folder, relay, fifo=False)
            before = process.cpu()
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sink:
                sink.bind(process.ways[0].sink)
                flood(process.ways[0], 1e6, duration)
                time.sleep(0.5)  # for what is in flight
                arrived = _count(sink)
            spent = process.cpu() - before
            process.stop()
            best[name] = max(best.get(name, 0.0), arrived / max(spent, 0.01))
    ratio = best[OURS] / best[OF_C]
    others = f"{OF_C} {best[OF_C]:,.0f}, asyncio {best[OF_ASYNCIO]:,.0f}"
    measured = f"{ratio:.2f} ({best[OURS]:,.0f})"
    return [Line(f"packets per CPU second / {OF_C}", ">= 0.5", measured, others, ratio >= 0.5)]


def _count(sink: socket.socket) -> int:
    """Count what has arrived at a socket: what waits, and what the kernel had no room for.

    Source: Linux, net/ipv4/udp.c, udp4_format_sock: last column of /proc/net/udp.
    """
    waiting, port = 0, sink.getsockname()[1]
    sink.setblocking(False)
    try:
        while sink.recv(SIZE):
            waiting += 1
    except BlockingIOError:
        pass
    for line in Path("/proc/net/udp").read_text().splitlines()[1:]:
        fields = line.split()
        if int(fields[1].rpartition(":")[2], 16) == port:
            return waiting + int(fields[-1])
    return waiting


class Row(NamedTuple):
    """One direction of one profile.

    Attributes:
        name: Of the profile.
        direction: "uplink" or "downlink".
        judged: The measurement.
        own_p99: The relay's own 99th percentile of its release error, both ways [s].
    """

    name: str
    direction: str
    judged: Judged
    own_p99: float


class _Task(NamedTuple):
    """Arguments of `run_flow` for one link."""

    ways: list[Way]
    rate: float
    duration: float
    begin: float


def measure_profiles(
    folder: Path, links: Links, duration: float, rate: float = 100.0, *, fifo: bool = False
) -> list[Row]:
    """Send through several links at the same time, both ways.

    Args:
        folder: For files.
        links: What they are.
        duration: Of the sending [s].
        rate: On each way [1/s].
        fifo: Whether the relays run under SCHED_FIFO.

    Returns:
        Two rows for each link.
    """
    flags = ("--fifo",) if fifo else ()
    relays = {name: ours(folder, link, *flags) for name, link in links.items()}
    # Once all processes are up: to start one takes processor time from the others.
    begin = time.monotonic() + START_EACH * (len(links) + 1)
    tasks = [_Task(one.ways, rate, duration, begin) for one in relays.values()]
    with ProcessPoolExecutor(len(tasks), mp_context=get_context("spawn")) as pool:
        flows = dict(zip(relays, pool.map(_send, tasks), strict=True))
    rows: list[Row] = []
    for name, relay in relays.items():
        relay.stop()
        own_p99 = relay.counts().get("release_error_p99", 0.0)
        origin_ns = min(min(flow.sent.values()) for flow in flows[name])
        for flow, profile in zip(flows[name], profiles_of(folder, links[name]), strict=True):
            direction = "uplink" if flow.uplink else "downlink"
            rows.append(Row(name, direction, judge(flow, profile, SEED, origin_ns), own_p99))
    return rows


def _send(task: _Task) -> list[Flow]:
    return run_flow(task.ways, task.rate, task.duration, TAIL, task.begin)


def profiles_of(folder: Path, link: dict[str, object]) -> tuple[DirectionProfile, DirectionProfile]:
    """Read what a link asks for: uplink, downlink."""
    path = folder / "asked.yaml"
    path.write_text(json.dumps({"seed": SEED, "mission": "hover", "link": link}))
    experiment = load_experiment(str(path))
    return link_profile(experiment.uplink), link_profile(experiment.downlink)


def random_walk(duration: float) -> Trace:
    """Make a trace of delays: a random walk about 40 ms in steps of 0.1 s, seeded."""
    generator, delays = np.random.default_rng(5), [0.040]
    for _ in range(round(duration * 10)):
        delay = delays[-1] + 0.004 * generator.standard_normal()
        delays.append(round(min(max(delay, 0.005), 0.120), 6))
    return Trace(tuple(number / 10 for number in range(len(delays))), tuple(delays))


def correlation(judged: Judged, profile: DirectionProfile) -> float:
    """Return the correlation of measured delays with the trace that was replayed."""
    assert profile.trace is not None
    times, delays = np.array(profile.trace.times), np.array(profile.trace.delays)
    asked = delays[np.clip(np.searchsorted(times, judged.sent, "right") - 1, 0, None)]
    return float(np.corrcoef(asked, judged.measured)[0, 1])


def judge_profiles(rows: list[Row], trace: DirectionProfile, wakes: Array) -> list[Line]:
    """Judge the shipped profiles and the replayed trace.

    Args:
        rows: What was measured.
        trace: Profile of the rows named `TRACE`.
        wakes: How late the C anchor woke in the same minute [s], shape (n,).
    """
    plain = [row for row in rows if row.name != TRACE]
    means = [abs(float(row.judged.errors.mean())) * MS for row in plain]
    spreads = [float(row.judged.errors.std()) * MS for row in plain]
    largest = max(float(row.judged.errors.max()) for row in plain) * MS
    wrong = sum(row.judged.wrongly_lost + row.judged.wrongly_arrived for row in rows)
    swapped = sum(row.judged.swapped for row in rows)
    early = sum(int((row.judged.errors < 0).sum()) for row in rows)
    count = sum(row.judged.errors.size for row in rows)
    least = min(float(row.judged.errors.min()) for row in rows)
    by = f", by {-least * MS:.4f} ms" if early else ""
    replayed = min(correlation(row.judged, trace) for row in rows if row.name == TRACE)
    woke = (float(wakes.mean()) * MS, float(wakes.std()) * MS, float(wakes.max()) * MS)
    return [
        Line("measured minus drawn, mean, worst profile", "<= 0.3 ms", f"{max(means):.3f} ms",
             f"{WAKE} {woke[0]:.3f} ms", max(means) <= 0.3),
        Line("measured minus drawn, deviation, worst", "<= 0.5 ms", f"{max(spreads):.3f} ms",
             f"{WAKE} {woke[1]:.3f} ms", max(spreads) <= 0.5),
        Line("measured minus drawn, largest", "told", f"{largest:.1f} ms",
             f"{WAKE} {woke[2]:.1f} ms", True),
        Line("lost or arrived, not as drawn", "0", f"{wrong} of {count}", "", wrong == 0),
        Line("out of the order drawn (by > 5 us)", "0", f"{swapped} of {count}", "", swapped == 0),
        Line("released early, profiles", "0", f"{early} of {count}{by}", "", early == 0),
        Line("replayed trace, correlation", ">= 0.98", f"{replayed:.4f}", "", replayed >= 0.98),
    ]  # fmt: skip


def detail(row: Row) -> dict[str, object]:
    """Describe one direction of one profile."""
    judged, errors = row.judged, row.judged.errors * MS
    return {
        "profile": row.name,
        "direction": row.direction,
        "arrived": errors.size,
        "drawn mean [ms]": f"{judged.drawn.mean() * MS:.3f}",
        "mean [ms]": f"{errors.mean():.3f}",
        "deviation [ms]": f"{errors.std():.3f}",
        "p50 [ms]": f"{np.median(errors):.3f}",
        "p99 [ms]": f"{np.quantile(errors, 0.99):.3f}",
        "largest [ms]": f"{errors.max():.3f}",
        "wrong": judged.wrongly_lost + judged.wrongly_arrived + judged.swapped,
        "its own p99 [ms]": f"{row.own_p99 * MS:.3f}",
    }


class Served(NamedTuple):
    """How a flow was served: packets lost, median and 99th percentile of the release error [s]."""

    lost: int
    p50: float
    p99: float


class Overloaded(NamedTuple):
    """Result of a flood.

    Attributes:
        offered: Packets sent.
        rate: At which they were sent [1/s].
        counts: What the relay has counted, both flows included.
        memory: Most that the relay held before and after the flood [bytes].
        before: How a flow was served before the flood.
        after: How the same flow was served 1 s after it.
    """

    offered: int
    rate: float
    counts: dict[str, float]
    memory: tuple[int, int]
    before: Served
    after: Served

    @property
    def accounted(self) -> float:
        """Return the share of what was offered that the relay has counted, in [0, 1]."""
        flows = 2 * FLOW_RATE * FLOW_DURATION
        return (self.counts["received"] + self.counts["unread"] - flows) / self.offered

    @property
    def recovered(self) -> bool:
        """Return whether nothing is lost and errors are at most twice those before."""
        before, after = self.before, self.after
        return after.lost == 0 and after.p50 <= 2 * before.p50 and after.p99 <= 2 * before.p99


def measure_overload(folder: Path, rate: float, duration: float) -> Overloaded:
    """Send a flow, flood, rest for 1 s, and send the flow again.

    Args:
        folder: For files.
        rate: Packets offered [1/s].
        duration: Of the flood [s].
    """
    relay = ours(folder, LINK)
    way = relay.ways[0]
    served, held = _serve(way), relay.memory()
    # Nobody reads what arrives: its kernel drops it, and the sender keeps its core to itself.
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sink:
        sink.bind(way.sink)
        began = time.monotonic()
        offered = flood(way, rate, duration, first=1 << 40)
        took = time.monotonic() - began
        time.sleep(1.0)
    held_then, served_then = relay.memory(), _serve(way)
    relay.stop()
    memory = (held, held_then)
    return Overloaded(offered, offered / took, relay.counts(), memory, served, served_then)


def _serve(way: Way) -> Served:
    (flow,) = run_flow([way], FLOW_RATE, FLOW_DURATION, 0.2)
    judged = judge(flow, DirectionProfile(DELAY), SEED, min(flow.sent.values()))
    p50, p99 = np.quantile(judged.errors, (0.5, 0.99)).tolist()
    return Served(judged.wrongly_lost, p50, p99)


def judge_overload(found: Overloaded) -> list[Line]:
    """Judge memory, counts and recovery of a flood."""
    before, after = (size / 2**20 for size in found.memory)
    counts, share = found.counts, found.accounted
    gone = counts["unread"] + counts["overflow"] + counts["unsent"]
    said = f"forwarded {counts['forwarded']:,.0f}, dropped {gone:,.0f}"
    errors = [f"p50 {one.p50 * US:.0f} us, p99 {one.p99 * US:.0f} us"
              for one in (found.before, found.after)]  # fmt: skip
    return [
        Line("flood: memory of the relay", "bounded", f"{after:.0f} MiB",
             f"before {before:.0f} MiB", after - before <= MEMORY_MAX / 2**20),
        Line(f"flood: counted of {found.offered:,} at {found.rate:,.0f}/s", ">= 99 %",
             f"{100 * share:.2f} %", said, 0.99 <= share <= 1.0001),
        Line("1 s after it: lost, release error", "0, <= 2 x before",
             f"{found.after.lost}, {errors[1]}", f"before {errors[0]}", found.recovered),
    ]  # fmt: skip


def bursts(start: float = 0.02, end: float = 0.2, count: int = 200_000) -> list[Line]:
    """Judge the Gilbert-Elliott bursts that the model draws; no clock, no socket.

    Args:
        start: Probability per packet that a burst begins, in [0, 1].
        end: Probability per packet that it ends, in [0, 1].
        count: Number of packets.
    """
    link = LinkDirection(DirectionProfile(loss=GilbertElliott(start, end)), SEED, True)
    lost = [not link.send(1, 3, n, SIZE, n * 10_000_000) for n in range(count)]
    runs = [sum(1 for _ in run) for one, run in groupby(lost) if one]
    rows = [
        ("bursts: loss, 200,000 packets", start / (start + end), sum(lost) / count, 4),
        ("bursts: mean length", 1.0 / end, sum(runs) / len(runs), 2),
    ]
    return [
        Line(what, f"{asked:.{digits}f} +-10 %", f"{drawn:.{digits}f}", "",
             abs(drawn / asked - 1) <= 0.1)
        for what, asked, drawn, digits in rows
    ]  # fmt: skip
