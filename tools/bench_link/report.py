"""Measurements beside what was asked of them, in lines for people."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from tools.bench_link.draws import Bursts
from tools.bench_link.judge import Array
from tools.bench_link.overload import Overloaded, Served
from tools.bench_link.profiles import Links, Row, correlation, profiles_of
from tools.bench_link.release import OF_ASYNCIO, OF_C, OURS, WAKE, Releases

TRACE = "trace"
MEMORY_MAX = 64 << 20
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


def releases(found: Releases, fifo: bool) -> list[Line]:
    """Judge the release errors at 1 kHz."""
    p99 = {name: found.quantile(name, 0.99) * US for name in found.errors}
    p50 = {name: found.quantile(name, 0.5) * US for name in found.errors}
    anchor = WAKE if fifo else OF_C
    early, count = found.early(OURS)
    ratio, worse = p99[OURS] / p99[anchor], p99[OF_ASYNCIO] / p99[OURS]
    others = f"{OF_C} {p50[OF_C]:.0f} us, asyncio {p50[OF_ASYNCIO]:.0f} us"
    tails = f"{anchor} {p99[anchor]:.0f} us, {OF_C} {p99[OF_C]:.0f} us"
    top = found.quantile(OURS, 0.999) * US
    cpu = {name: 100 * float(np.median(shares)) for name, shares in found.cpu.items()}
    how = "SCHED_FIFO" if fifo else "normal priority"
    return [
        Line(f"release error p50, 1 kHz, {how}", "<= 60 us", f"{p50[OURS]:.1f} us", others,
             p50[OURS] <= 60),
        Line(f"release error p99 / {anchor} p99", "<= 1.5", f"{ratio:.2f} ({p99[OURS]:.0f} us)",
             tails, ratio <= 1.5),
        Line("asyncio relay p99 / release error p99", ">= 20", f"{worse:.0f}",
             f"asyncio {p99[OF_ASYNCIO]:.0f} us", worse >= 20 or not fifo),
        Line("release error p99.9", "told", f"{top:.0f} us",
             f"{OF_C} {found.quantile(OF_C, 0.999) * US:.0f} us", True),
        Line("released early", "0", f"{early} of {count}", "", early == 0),
        Line("share of a core at 1 kHz", "told", f"{cpu[OURS]:.1f} %",
             f"{OF_C} {cpu[OF_C]:.1f} %, asyncio {cpu[OF_ASYNCIO]:.1f} %", True),
    ]  # fmt: skip


def throughput(best: dict[str, float]) -> list[Line]:
    """Judge the packets per second of processor time."""
    ratio = best[OURS] / best[OF_C]
    others = f"{OF_C} {best[OF_C]:,.0f}, asyncio {best[OF_ASYNCIO]:,.0f}"
    measured = f"{ratio:.2f} ({best[OURS]:,.0f})"
    return [Line(f"packets per CPU second / {OF_C}", ">= 0.5", measured, others, ratio >= 0.5)]


def profiles(
    folder: Path, rows: list[Row], links: Links, wakes: Array
) -> tuple[list[Line], list[dict[str, object]]]:
    """Judge the shipped profiles and the replayed trace.

    Args:
        folder: For files.
        rows: What was measured.
        links: What was asked.
        wakes: How late the C anchor woke in the same minute [s], shape (n,).

    Returns:
        Lines, and a row of a table for each direction of each profile.
    """
    plain = [row for row in rows if row.name != TRACE]
    means = [abs(float(row.judged.errors.mean())) * MS for row in plain]
    spreads = [float(row.judged.errors.std()) * MS for row in plain]
    wrong = sum(row.judged.wrongly_lost + row.judged.wrongly_arrived for row in rows)
    swapped = sum(row.judged.swapped for row in rows)
    early = sum(int((row.judged.errors < 0).sum()) for row in rows)
    count = sum(row.judged.errors.size for row in rows)
    least = min(float(row.judged.errors.min()) for row in rows)
    by = f", by {-least * MS:.4f} ms" if early else ""
    replayed = min(
        correlation(row.judged, profile)
        for row, profile in zip(
            (row for row in rows if row.name == TRACE), profiles_of(folder, links[TRACE]),
            strict=True,
        )
    )  # fmt: skip
    woke = (float(wakes.mean()) * MS, float(wakes.std()) * MS, float(wakes.max()) * MS)
    largest = max(float(row.judged.errors.max()) for row in plain) * MS
    lines = [
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


def overload(found: Overloaded) -> list[Line]:
    """Judge what came of the flood."""
    before, after = (size / 2**20 for size in found.memory)
    counts = found.counts
    gone = counts["unread"] + counts["overflow"] + counts["unsent"]
    said = f"forwarded {counts['forwarded']:,.0f}, dropped {gone:,.0f}"
    share = found.accounted
    return [
        Line("flood: memory of the relay", "bounded", f"{after:.0f} MiB",
             f"before {before:.0f} MiB", after - before <= MEMORY_MAX / 2**20),
        Line(f"flood: counted of {found.offered:,} at {found.rate:,.0f}/s", ">= 99 %",
             f"{100 * share:.2f} %", said, 0.99 <= share <= 1.0001),
        Line("1 s after it: lost, release error", "0, <= 2 x before",
             f"{found.after.lost}, {_errors(found.after)}", f"before {_errors(found.before)}",
             found.recovered),
    ]  # fmt: skip


def _errors(served: Served) -> str:
    return f"p50 {served.p50 * US:.0f} us, p99 {served.p99 * US:.0f} us"


def bursts(found: Bursts) -> list[Line]:
    """Judge the Gilbert-Elliott chain."""
    loss, length = found.loss_drawn / found.loss_asked, found.length_drawn / found.length_asked
    return [
        Line("bursts: loss, 200,000 packets", f"{found.loss_asked:.4f} +-10 %",
             f"{found.loss_drawn:.4f}", "", abs(loss - 1) <= 0.1),
        Line("bursts: mean length", f"{found.length_asked:.2f} +-10 %",
             f"{found.length_drawn:.2f}", "", abs(length - 1) <= 0.1),
    ]  # fmt: skip
