"""Time lines and traces in the kernel: stepped when they are due, and measured at the far end."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from cloudrc.link.netem import LATE_NS, Steps
from cloudrc.link.profile import Blackout, Change, DirectionProfile, Trace
from tests.link import conftest as lab
from tests.link.conftest import WITHIN, Flow, least, show

LATE = 0.1
"""How late a step may be where the machine now and then stands still [s]."""
LATE_SHARE = 0.1
"""Which share of the steps that are due every 20 ms may come later than that, or not at all. Each
one waits for tc's answer, some ms in an emulated machine, and where that stands still for 0.1 s,
the five that were due meanwhile are late or passed over: room for eight such stops in 8 s. Yet who
stepped every 22 ms instead would pass over as many."""
pytestmark = pytest.mark.netem


def test_a_time_line_is_stepped(tables: Path) -> None:
    profile = DirectionProfile(
        delay=0.02, changes=(Change(2.5, delay=0.1),), blackouts=(Blackout(3.5, 0.3),)
    )
    origin_ns = time.monotonic_ns() + 5_000_000_000  # by then it is set up
    begun_ns = origin_ns + time.time_ns() - time.monotonic_ns()
    netem, flow = lab.real_netem(tables, profile, origin_ns), Flow()
    netem.follow_peer(lab.FAR_PEER)
    while time.monotonic_ns() < origin_ns + 4_500_000_000:
        flow.send(1, 0.01, meanwhile=lambda: netem.step(0.0))
    netem.close()
    flow.settle()
    assert (netem.steps.applied, netem.steps.passed_over) == (3, 0)
    assert netem.steps.lateness_ns()[1] * 1e-9 < LATE, "by its own account"
    since = {n: (at_ns - begun_ns) * 1e-9 for n, at_ns in enumerate(flow.sent_ns)}
    delays = dict(zip(flow.numbers(), flow.delays(), strict=True))
    before = [delays[n] for n in delays if since[n] < 2.45]
    after = [delays[n] for n in delays if since[n] > 2.5 + LATE]
    lost = [since[n] for n in since if n not in delays and since[n] < 4.2]
    show("step", before=np.median(before), after=np.median(after), dark=max(lost) - min(lost))
    assert np.median(before) == pytest.approx(0.02, abs=0.005)
    assert np.median(after) == pytest.approx(0.1, abs=0.005)
    assert min(lost) == pytest.approx(3.5, abs=LATE)
    assert max(lost) == pytest.approx(3.8, abs=LATE)


def late_share(steps: Steps) -> float:
    """Give the share of steps that were late, or were over before their turn came."""
    return (steps.late + steps.passed_over) / (steps.applied + steps.passed_over)


class Followed(NamedTuple):
    """How a trace was followed: correlation with it, the median error [s], and its steps."""

    correlation: float
    error: float
    steps: Steps


def follow(tables: Path, trace: Trace) -> Followed:
    """Let netem follow a trace, and measure."""
    profile = DirectionProfile(trace=trace)
    origin_ns = time.monotonic_ns() + 3_000_000_000  # by then it is set up
    begun_ns = origin_ns + time.time_ns() - time.monotonic_ns()
    netem, flow = lab.real_netem(tables, profile, origin_ns), Flow()
    netem.follow_peer(lab.FAR_PEER)
    sender = threading.Thread(target=flow.send, args=(600, 0.02))
    sender.start()
    while sender.is_alive():
        netem.step(0.1)
    flow.settle()
    netem.close()
    since = (np.array(flow.sent_ns)[flow.numbers()] - begun_ns) * 1e-9
    times = np.array(trace.times)
    rows = (since > 0.0) & (since < times[-1])
    asked = np.array(trace.delays)[np.searchsorted(times, since[rows], side="right") - 1]
    measured = flow.delays()[rows]
    correlation = float(np.corrcoef(asked, measured)[0, 1])
    error = float(np.median(measured - asked))
    show(netem.steps.in_words(), correlation=correlation, median_error=error)
    assert netem.steps.applied + netem.steps.passed_over == len(times) - 1
    assert len(flow.arrived) == 600, "steps lose nothing"
    return Followed(correlation, error, netem.steps)


def test_a_trace_is_followed(tables: Path) -> None:
    """60 to 140 ms in waves of 4 s, one row per 20 ms; measured at the instants of sending."""
    times = 0.02 * np.arange(400)
    delays = 0.1 + 0.04 * np.sin(0.5 * np.pi * times)
    trace = Trace(tuple(times.tolist()), tuple(delays.tolist()))
    found: list[Followed] = []

    def off() -> float:
        found.append(follow(tables, trace))
        correlation, _, steps = found[-1]
        return max((1.0 - correlation) / 0.02, late_share(steps) / LATE_SHARE)

    assert least(off, 1.0) < 1.0, "correlation or lateness, in units of what is allowed"
    assert found[-1].steps.lateness_ns()[0] < LATE_NS, "in the median, by its own account"
    assert min(abs(one.error) for one in found) < 3 * WITHIN, "its clock is slow"
