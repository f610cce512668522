"""`make bench-link` judges flows by the model, and ends with 3 without a compiler."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from cloudrc.link.model import LinkDirection
from cloudrc.link.profile import DirectionProfile
from cloudrc.tunnel.codec import Kind
from tools.bench_link.flow import EPOCH, SIZE, Flow, judge, since_first_ns
from tools.bench_link.stages import bursts

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
