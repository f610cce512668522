"""Measure the relay, each stage beside what is asked of it and beside anchors of the same run."""

from __future__ import annotations

import json
import socket
import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import suppress
from itertools import groupby
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np

from cloudrc.assembly import link_profile
from cloudrc.config.load import load_experiment
from cloudrc.config.shipped import names
from cloudrc.link.model import LinkDirection
from cloudrc.link.profile import DirectionProfile, GilbertElliott, Trace
from cloudrc.link.traces import write_trace
from tools.bench_link.flow import SIZE, Flow, Judged, Way, flood, judge, run_flow
from tools.bench_link.relays import DELAY, EMPTY, Process, of_asyncio, of_c, ours, wake_lateness

OURS, OF_C, OF_ASYNCIO, WAKE = "cloudrc relay", "C relay", "asyncio relay", "C clock_nanosleep"
SEED = 1
LINK: dict[str, object] = {"profile": "ideal", "uplink": {"delay_ms": DELAY * 1e3}}
Links: TypeAlias = dict[str, dict[str, object]]
"""Name -> the section `link` of an experiment file."""
MEMORY_MAX = 64
"""Limit of the memory that a flood may take [MiB]."""
FLOW_RATE, FLOW_DURATION = 200.0, 3.0
"""Of the flow before and after a flood: rate [1/s] and duration [s]."""
US, MS = 1e6, 1e3


class Line(NamedTuple):
    """One thing that was asked: in words, the bound, the result, anchors, whether it is held."""

    what: str
    asked: str
    measured: str
    anchor: str
    held: bool


def start(name: str, folder: Path, relay: Path, *, fifo: bool) -> Process:
    """Start one of the three relays."""
    if name == OURS:
        return ours(folder, LINK, *(("--fifo",) if fifo else ()))
    process = of_c(relay) if name == OF_C else of_asyncio()
    if fifo:
        process.use_fifo()
    return process


def releases(
    folder: Path, programs: tuple[Path, Path], rounds: int, duration: float, *, fifo: bool
) -> list[Line]:
    """Measure the release errors of all relays at 1 kHz, in turns."""
    errors: dict[str, list[np.ndarray]] = {WAKE: [], OURS: [], OF_C: [], OF_ASYNCIO: []}
    shares: dict[str, list[float]] = {OURS: [], OF_C: [], OF_ASYNCIO: []}
    for _ in range(rounds):
        errors[WAKE].append(wake_lateness(programs[0], round(1000 * duration), fifo=fifo))
        for name in shares:
            process = start(name, folder, programs[1], fifo=fifo)
            before, began = process.cpu(), time.monotonic()
            (flow,) = run_flow(process.ways[:1], 1000.0, duration, 2 * DELAY)
            shares[name].append((process.cpu() - before) / (time.monotonic() - began))
            process.stop()
            judged = judge(flow, DirectionProfile(DELAY), SEED, min(flow.sent.values()))
            errors[name].append(judged.errors)
    # Quantiles of each round, and their median over the rounds [us].
    p50, p99, top = (
        {name: US * float(np.median([np.quantile(one, q) for one in rounds]))
         for name, rounds in errors.items()}
        for q in (0.5, 0.99, 0.999)
    )  # fmt: skip
    cpu = {name: 100 * float(np.median(share)) for name, share in shares.items()}
    anchor, how = (WAKE, "SCHED_FIFO") if fifo else (OF_C, "normal priority")
    early = sum(int((one < 0).sum()) for one in errors[OURS])
    ratio, worse = p99[OURS] / p99[anchor], p99[OF_ASYNCIO] / p99[OURS]
    return [
        Line(f"release error p50, 1 kHz, {how}", "<= 60 us", f"{p50[OURS]:.1f} us",
             f"{OF_C} {p50[OF_C]:.0f} us, asyncio {p50[OF_ASYNCIO]:.0f} us", p50[OURS] <= 60),
        Line(f"release error p99 / {anchor} p99", "<= 1.5", f"{ratio:.2f} ({p99[OURS]:.0f} us)",
             f"{anchor} {p99[anchor]:.0f} us, {OF_C} {p99[OF_C]:.0f} us", ratio <= 1.5),
        Line("asyncio relay p99 / release error p99", ">= 20", f"{worse:.0f}",
             f"asyncio {p99[OF_ASYNCIO]:.0f} us", worse >= 20 or not fifo),
        Line("release error p99.9", "told", f"{top[OURS]:.0f} us", f"{OF_C} {top[OF_C]:.0f} us",
             True),
        Line("released early", "0", f"{early} of {sum(map(len, errors[OURS]))}", "", early == 0),
        Line("share of a core at 1 kHz", "told", f"{cpu[OURS]:.1f} %",
             f"{OF_C} {cpu[OF_C]:.1f} %, asyncio {cpu[OF_ASYNCIO]:.1f} %", True),
    ]  # fmt: skip


def throughput(folder: Path, relay: Path, rounds: int, duration: float) -> list[Line]:
    """Offer relays more than they can take, in turns; judge the packets per CPU second."""
    best = {OURS: 0.0, OF_C: 0.0, OF_ASYNCIO: 0.0}
    for _ in range(rounds):
        for name in best:
            process = start(name, folder, relay, fifo=False)
            before = process.cpu()
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sink:
                sink.bind(process.ways[0].sink)
                flood(process.ways[0], 1e6, duration)
                time.sleep(0.5)  # for what is in flight
                arrived = _count(sink)
            best[name] = max(best[name], arrived / max(process.cpu() - before, 0.01))
            process.stop()
    ratio = best[OURS] / best[OF_C]
    others = f"{OF_C} {best[OF_C]:,.0f}, asyncio {best[OF_ASYNCIO]:,.0f}"
    measured = f"{ratio:.2f} ({best[OURS]:,.0f})"
    return [Line(f"packets per CPU second / {OF_C}", ">= 0.5", measured, others, ratio >= 0.5)]


def _count(sink: socket.socket) -> int:
    """Count what has arrived at a socket: what waits, and what the kernel had no room for.

    Source: Linux, net/ipv4/udp.c, udp4_format_sock: last column of /proc/net/udp.
    """
    waiting, port = 0, f":{sink.getsockname()[1]:04X}"
    sink.setblocking(False)
    with suppress(BlockingIOError):
        while True:
            sink.recv(SIZE)
            waiting += 1
    rows = [line.split() for line in Path("/proc/net/udp").read_text().splitlines()[1:]]
    return waiting + sum(int(row[-1]) for row in rows if row[1].endswith(port))


class Row(NamedTuple):
    """One direction of one profile, and the relay's own 99th percentile, both ways [s]."""

    name: str
    direction: str
    judged: Judged
    own_p99: float


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
    relays = {n: ours(folder, link, *(("--fifo",) if fifo else ())) for n, link in links.items()}
    # Once all senders are up: to start one takes 0.6 s of processor time from the others.
    begin = time.monotonic() + 0.6 * (len(links) + 1)
    tasks = [(one.ways, rate, duration, 1.2, begin) for one in relays.values()]
    with ProcessPoolExecutor(len(tasks), mp_context=get_context("spawn")) as pool:
        flows = dict(zip(relays, pool.map(_send, tasks), strict=True))
    rows: list[Row] = []
    for name, relay in relays.items():
        relay.stop()
        own_p99 = relay.counts().get("release_error_p99_ns", 0.0) * 1e-9
        origin_ns = min(min(flow.sent.values()) for flow in flows[name])
        for flow, profile in zip(flows[name], profiles_of(folder, links[name]), strict=True):
            direction = "uplink" if flow.uplink else "downlink"
            rows.append(Row(name, direction, judge(flow, profile, SEED, origin_ns), own_p99))
    return rows


def _send(task: tuple[list[Way], float, float, float, float]) -> list[Flow]:
    return run_flow(*task)


def profiles_of(folder: Path, link: dict[str, object]) -> tuple[DirectionProfile, DirectionProfile]:
    """Read what a link asks for: uplink, downlink."""
    path = folder / "asked.yaml"
    path.write_text(json.dumps({"seed": SEED, **EMPTY, "link": link}))
    experiment = load_experiment(str(path))
    return link_profile(experiment.uplink), link_profile(experiment.downlink)


def replayed_trace(folder: Path) -> dict[str, object]:
    """Write a trace of 60 s, a random walk about 40 ms in steps of 0.1 s, and name it in a link."""
    generator, delays = np.random.default_rng(5), [0.040]
    for _ in range(600):
        delay = delays[-1] + 0.004 * generator.standard_normal()
        delays.append(round(min(max(delay, 0.005), 0.120), 6))
    trace = Trace(tuple(number / 10 for number in range(len(delays))), tuple(delays))
    (folder / "trace.csv").write_text(write_trace(trace))
    way = {"trace": str(folder / "trace.csv")}
    return {"profile": "ideal", "uplink": way, "downlink": way}


def correlation(judged: Judged, profile: DirectionProfile) -> float:
    """Return the correlation of measured delays with the trace that was replayed."""
    assert profile.trace is not None
    times, delays = np.array(profile.trace.times), np.array(profile.trace.delays)
    asked = delays[np.clip(np.searchsorted(times, judged.sent, "right") - 1, 0, None)]
    return float(np.corrcoef(asked, judged.measured)[0, 1])


def profiles(
    folder: Path, wake: Path, seconds: float, *, fifo: bool
) -> tuple[list[Line], list[dict[str, object]]]:
    """Judge the shipped profiles and a replayed trace; also describe each direction."""
    links: Links = {name: {"profile": name} for name in names("profile")}
    links["trace"] = replayed_trace(folder)
    with ThreadPoolExecutor(1) as pool:  # what the machine does in the same minute
        late = pool.submit(wake_lateness, wake, round(1000 * (seconds + 7.0)), fifo=fifo)
        rows = measure_profiles(folder, links, seconds, fifo=fifo)
    wakes, trace = late.result() * MS, profiles_of(folder, links["trace"])[0]
    errors = [row.judged.errors * MS for row in rows]
    plain = [one for row, one in zip(rows, errors, strict=True) if row.name != "trace"]
    mean, spread = max(abs(one.mean()) for one in plain), max(one.std() for one in plain)
    wrong = sum(row.judged.wrongly_lost + row.judged.wrongly_arrived for row in rows)
    swapped = sum(row.judged.swapped for row in rows)
    every = np.concatenate(errors)
    early, count = int((every < 0).sum()), every.size
    by = f", by {-every.min():.4f} ms" if early else ""
    replayed = min(correlation(row.judged, trace) for row in rows if row.name == "trace")
    lines = [
        Line("measured minus drawn, mean, worst profile", "<= 0.3 ms", f"{mean:.3f} ms",
             f"{WAKE} {wakes.mean():.3f} ms", mean <= 0.3),
        Line("measured minus drawn, deviation, worst", "<= 0.5 ms", f"{spread:.3f} ms",
             f"{WAKE} {wakes.std():.3f} ms", spread <= 0.5),
        Line("measured minus drawn, largest", "told", f"{max(map(np.max, plain)):.1f} ms",
             f"{WAKE} {wakes.max():.1f} ms", True),
        Line("lost or arrived, not as drawn", "0", f"{wrong} of {count}", "", wrong == 0),
        Line("out of the order drawn (by > 5 us)", "0", f"{swapped} of {count}", "", swapped == 0),
        Line("released early, profiles", "0", f"{early} of {count}{by}", "", early == 0),
        Line("replayed trace, correlation", ">= 0.98", f"{replayed:.4f}", "", replayed >= 0.98),
    ]  # fmt: skip
    return lines, [_detail(row) for row in rows]


def _detail(row: Row) -> dict[str, object]:
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


def overload(folder: Path, rate: float, duration: float) -> list[Line]:
    """Send a flow, flood, rest for 1 s, and send the flow again.

    Args:
        folder: For files.
        rate: Packets offered [1/s].
        duration: Of the flood [s].
    """
    relay = ours(folder, LINK)
    way = relay.ways[0]

    def serve() -> tuple[int, float, float, float]:
        """Lost packets, median and 99th percentile of the error [us], memory [MiB]."""
        (flow,) = run_flow([way], FLOW_RATE, FLOW_DURATION, 0.2)
        flow.arrived = [one for one in flow.arrived if one[1] in flow.sent]  # not the flood's
        judged = judge(flow, DirectionProfile(DELAY), SEED, min(flow.sent.values()))
        p50, p99 = US * np.quantile(judged.errors, (0.5, 0.99))
        return judged.wrongly_lost, float(p50), float(p99), relay.memory() / 2**20

    _, p50, p99, before = serve()
    # Nobody reads what arrives: its kernel drops it, and the sender keeps its core to itself.
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sink:
        sink.bind(way.sink)
        began = time.monotonic()
        offered = flood(way, rate, duration, first=1 << 40)
        took = time.monotonic() - began
        time.sleep(1.0)
    lost, p50_then, p99_then, after = serve()
    relay.stop()
    counts = relay.counts()
    flows = 2 * FLOW_RATE * FLOW_DURATION
    share = (counts["received"] + counts["unread"] - flows) / offered
    gone = counts["unread"] + counts["overflow"] + counts["unsent"]
    recovered = lost == 0 and p50_then <= 2 * p50 and p99_then <= 2 * p99
    return [
        Line("flood: memory of the relay", "bounded", f"{after:.0f} MiB",
             f"before {before:.0f} MiB", after - before <= MEMORY_MAX),
        Line(f"flood: counted of {offered:,} at {offered / took:,.0f}/s", ">= 99 %",
             f"{100 * share:.2f} %",
             f"forwarded {counts['forwarded']:,.0f}, dropped {gone:,.0f}",
             0.99 <= share <= 1.0001),
        Line("1 s after it: lost, release error", "0, <= 2 x before",
             f"{lost}, p50 {p50_then:.0f} us, p99 {p99_then:.0f} us",
             f"before p50 {p50:.0f} us, p99 {p99:.0f} us", recovered),
    ]  # fmt: skip


def bursts() -> list[Line]:
    """Judge the Gilbert-Elliott bursts that the model draws; no clock, no socket."""
    start, end, count = 0.02, 0.2, 200_000
    link = LinkDirection(DirectionProfile(loss=GilbertElliott(start, end)), SEED, True)
    lost = [not link.send(1, 3, n, SIZE, n * 10_000_000) for n in range(count)]
    runs = [sum(1 for _ in run) for one, run in groupby(lost) if one]
    loss, length = sum(lost) / count, sum(runs) / len(runs)
    asked = start / (start + end)
    return [
        Line("bursts: loss, 200,000 packets", f"{asked:.4f} +-10 %", f"{loss:.4f}", "",
             abs(loss / asked - 1) <= 0.1),
        Line("bursts: mean length", f"{1 / end:.2f} +-10 %", f"{length:.2f}", "",
             abs(length * end - 1) <= 0.1),
    ]  # fmt: skip
