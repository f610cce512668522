"""`make bench-link` reports missed targets and exits with 3 without a compiler."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from cloudrc.link.model import LinkDirection
from cloudrc.link.profile import DirectionProfile
from cloudrc.tunnel.codec import Kind
from tools.bench_link.draws import measure_bursts
from tools.bench_link.flow import EPOCH, SIZE, Flow, since_first_ns
from tools.bench_link.judge import judge
from tools.bench_link.overload import Overloaded, Served
from tools.bench_link.release import OF_ASYNCIO, OF_C, OURS, WAKE, Releases
from tools.bench_link.report import bursts, overload, releases

ROOT = Path(__file__).resolve().parents[2]
MS = 1_000_000
START = 1_700_000_000_000_000_000
PROFILE = DirectionProfile(0.040, 0.030, loss=0.1)


def flow(late_ns: int) -> Flow:
    """Make the results of a relay with a constant lateness."""
    made, link = Flow(True), LinkDirection(PROFILE, 1, True, START)
    for number in range(500):
        made.sent[number] = START + number * 10 * MS
        for at_ns in link.send(EPOCH, Kind.TELEMETRY, number, SIZE, made.sent[number]):
            made.arrived.append((at_ns + late_ns, number))
    made.arrived.sort()
    return made


def test_an_honest_flow_is_as_drawn() -> None:
    judged = judge(flow(20_000), PROFILE, 1, START)
    assert (judged.wrongly_lost, judged.wrongly_arrived, judged.swapped) == (0, 0, 0)
    assert judged.errors == pytest.approx(20e-6)
    assert judged.errors.size < 500
    assert judged.measured - judged.drawn == pytest.approx(judged.errors, abs=1e-9)


def test_what_is_lost_invented_or_swapped_is_found() -> None:
    found = flow(0)
    lost = next(n for n in range(500) if n not in {number for _, number in found.arrived})
    del found.arrived[7]
    found.arrived.append((START, lost))
    found.arrived[100], found.arrived[101] = found.arrived[101], found.arrived[100]
    judged = judge(found, PROFILE, 1, START)
    assert (judged.wrongly_lost, judged.wrongly_arrived, judged.swapped) == (1, 1, 1)


@pytest.mark.parametrize("ways", [1, 2])
def test_no_datagram_leaves_while_a_row_of_a_trace_may_begin(ways: int) -> None:
    """One that is stamped before a change, and arrives after it, would be judged by the wrong row.

    It would be seen "early" by the difference of the two rows, some milliseconds.
    """
    period_ns = 10 * MS
    sent = [since_first_ns(n, turn, ways, period_ns) for n in range(20) for turn in range(ways)]
    assert sent[0] == 0
    assert sent == sorted(sent)
    assert min(min(at % period_ns, -at % period_ns) for at in sent[1:]) == period_ns // 4


@pytest.mark.parametrize(
    ("fifo", "ours_us", "missed"),
    [
        (True, 20.0, set()),
        (True, 55.0, {"p99"}),
        (True, 80.0, {"p50", "p99", "asyncio"}),
        (True, -5.0, {"early"}),
        (False, 55.0, set()),
        (False, 80.0, {"p50", "p99"}),
        (False, -5.0, {"early"}),
    ],
)
def test_release_errors_are_judged_against_the_runs_anchors(
    fifo: bool, ours_us: float, missed: set[str]
) -> None:
    """Without SCHED_FIFO: the p99 is at most 1.5 times the C relay's, not a waking's."""
    sizes = {OURS: ours_us, OF_C: 40.0, OF_ASYNCIO: 1150.0, WAKE: 30.0}
    found = Releases(
        {name: [np.full(1000, us * 1e-6)] for name, us in sizes.items()},
        {name: [0.05] for name in (OURS, OF_C, OF_ASYNCIO)},
    )
    lines = releases(found, fifo=fifo)
    wrong = [line.what for line in lines if not line.held]
    if missed == {"early"}:
        assert "released early" in wrong
    else:
        assert len(wrong) == len(missed)
        assert all(any(word in what for what in wrong) for word in missed)


@pytest.mark.parametrize(
    ("after", "held"),
    [
        (Served(0, 90e-6, 500e-6), True),
        (Served(1, 50e-6, 300e-6), False),
        (Served(0, 110e-6, 300e-6), False),
        (Served(0, 50e-6, 700e-6), False),
    ],
)
def test_service_after_a_flood_is_held_against_that_before_it(after: Served, held: bool) -> None:
    counts = {"received": 1_001_200.0, "unread": 0.0, "overflow": 0.0, "unsent": 0.0}
    counts["forwarded"] = counts["received"]
    before = Served(0, 50e-6, 300e-6)
    found = Overloaded(1_000_000, 1e5, counts, (57 << 20, 59 << 20), before, after)
    assert [line.held for line in overload(found)] == [True, True, held]


def test_bursts_are_as_asked_in_200_000_packets() -> None:
    assert all(line.held for line in bursts(measure_bursts()))


def test_without_a_compiler_it_ends_with_3(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "tools.bench_link", "--only", "bursts"],
        cwd=ROOT,
        env={"PATH": str(tmp_path)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 3, done.stderr
    assert "no C compiler" in done.stderr
    assert done.stdout == ""
