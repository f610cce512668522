"""`make bench-link` judges what it measures, and ends with 3 without a compiler."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from cloudrc.link.model import LinkDirection
from cloudrc.link.profile import DirectionProfile
from cloudrc.tunnel.codec import Kind
from tools.bench_link.flow import EPOCH, SIZE, Flow, judge, since_first_ns
from tools.bench_link.stages import (
    OF_ASYNCIO,
    OF_C,
    OURS,
    WAKE,
    Overloaded,
    Releases,
    Served,
    bursts,
    judge_overload,
    judge_releases,
)

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


def test_lost_invented_and_swapped_datagrams_are_found() -> None:
    honest = judge(flow(20_000), PROFILE, 1, START)
    assert (honest.wrongly_lost, honest.wrongly_arrived, honest.swapped) == (0, 0, 0)
    assert honest.errors == pytest.approx(20e-6)
    assert honest.measured - honest.drawn == pytest.approx(honest.errors, abs=1e-9)
    found = flow(0)
    lost = next(n for n in range(500) if n not in {number for _, number in found.arrived})
    del found.arrived[7]
    found.arrived.append((START, lost))
    found.arrived[100], found.arrived[101] = found.arrived[101], found.arrived[100]
    judged = judge(found, PROFILE, 1, START)
    assert (judged.wrongly_lost, judged.wrongly_arrived, judged.swapped) == (1, 1, 1)


@pytest.mark.parametrize("ways", [1, 2])
def test_no_datagram_leaves_while_a_row_of_a_trace_may_begin(ways: int) -> None:
    """One that left before a change and arrived after it would be judged by the wrong row."""
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
    ],
)
def test_release_errors_are_judged_against_the_runs_anchors(
    fifo: bool, ours_us: float, missed: set[str]
) -> None:
    sizes = {OURS: ours_us, OF_C: 40.0, OF_ASYNCIO: 1150.0, WAKE: 30.0}
    found = Releases(
        {name: [np.full(1000, us * 1e-6)] for name, us in sizes.items()},
        {name: [0.05] for name in (OURS, OF_C, OF_ASYNCIO)},
    )
    wrong = [line.what for line in judge_releases(found, fifo=fifo) if not line.held]
    assert {word for word in missed if any(word in what for what in wrong)} == missed
    assert missed == {"early"} or len(wrong) == len(missed)


@pytest.mark.parametrize(
    ("after", "held"),
    [
        (Served(0, 90e-6, 500e-6), True),
        (Served(1, 50e-6, 300e-6), False),
        (Served(0, 110e-6, 300e-6), False),
        (Served(0, 50e-6, 700e-6), False),
    ],
)
def test_service_after_a_flood_is_compared_with_that_before(after: Served, held: bool) -> None:
    counts = {"received": 1_001_200.0, "unread": 0.0, "overflow": 0.0, "unsent": 0.0}
    counts["forwarded"] = counts["received"]
    before = Served(0, 50e-6, 300e-6)
    found = Overloaded(1_000_000, 1e5, counts, (57 << 20, 59 << 20), before, after)
    assert [line.held for line in judge_overload(found)] == [True, True, held]


def test_bursts_are_as_asked_in_200_000_packets() -> None:
    assert all(line.held for line in bursts())


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
