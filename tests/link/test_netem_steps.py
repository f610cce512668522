"""Time lines and traces become steps of the qdisc, each as soon as it is due, and none too many."""

from __future__ import annotations

import pytest

from cloudrc.link.netem import Steps
from cloudrc.link.profile import Blackout, Change, DirectionProfile, Trace
from tests.link.conftest import PEER, Clock, Kernel, netem


class Watched(Kernel):
    """Notes which delay [us] and loss were in force from when on [ms]."""

    def __init__(self, clock: Clock, slow_ms: int = 0) -> None:
        super().__init__()
        self.clock, self.slow_ms, self.history = clock, slow_ms, list[tuple[float, str, str]]()

    def run(self, words):  # type: ignore[no-untyped-def]
        answer = super().run(words)
        if "change" in words:
            self.clock.now_ns += self.slow_ms * 1_000_000
            at = words.index("delay")
            loss = words[words.index("loss") + 2]
            self.history.append((self.clock.now_ns * 1e-6, words[at + 1], loss))
        return answer


def follow(profile: DirectionProfile, until: float, slow_ms: int = 0) -> tuple[Watched, Steps]:
    clock = Clock()
    kernel = Watched(clock, slow_ms)
    shaper = netem(kernel, profile, clock)
    shaper.follow_peer(PEER)
    while clock.now_ns < until * 1e9:
        shaper.step(0.1)
    return kernel, shaper.steps


def test_a_step_is_taken_when_it_is_due_and_not_only_every_20_ms() -> None:
    profile = DirectionProfile(
        delay=0.02, changes=(Change(1.003, delay=0.1),), blackouts=(Blackout(1.511, 0.05),)
    )
    kernel, steps = follow(profile, 2.0)
    assert kernel.history == [
        (pytest.approx(1003.0), "100000.000us", "0%"),
        (pytest.approx(1511.0), "100000.000us", "100%"),
        (pytest.approx(1561.0), "100000.000us", "0%"),
    ]
    assert (steps.applied, steps.late, steps.passed_over) == (3, 0, 0)


def test_a_trace_is_stepped_at_each_of_its_rows() -> None:
    times = tuple(0.01 * n for n in range(100))
    trace = Trace(times, tuple(0.03 + 1e-4 * n for n in range(100)), (0.0,) * 50 + (0.1,) * 50)
    kernel, steps = follow(DirectionProfile(trace=trace), 1.2)
    assert [at for at, _, _ in kernel.history] == pytest.approx([10.0 * n for n in range(1, 100)])
    assert kernel.history[9][1:] == ("31000.000us", "0%")
    assert kernel.history[-1][1:] == ("39900.000us", "10%")
    assert steps.applied == 99


def test_changes_faster_than_the_step_are_skipped_and_counted() -> None:
    times = tuple(0.001 * n for n in range(1000))
    trace = Trace(times, tuple(0.03 + 1e-5 * n for n in range(1000)))
    kernel, steps = follow(DirectionProfile(trace=trace), 1.2)
    gaps = [b[0] - a[0] for a, b in zip(kernel.history, kernel.history[1:], strict=False)]
    assert min(gaps) >= 4.999
    assert steps.applied + steps.passed_over == 999
    assert steps.applied >= 199
    assert kernel.history[-1][1] == "39990.000us"


def test_a_slow_machine_tells_its_own_lateness() -> None:
    changes = tuple(Change(0.1 * n, delay=0.01 * n) for n in range(1, 11))
    _, steps = follow(DirectionProfile(changes=changes), 1.5, slow_ms=30)
    assert (steps.applied, steps.late) == (10, 10)
    assert steps.lateness_ns() == (30_000_000, 30_000_000)
    steps.note(40_000_000, 0)
    assert steps.lateness_ns() == (30_000_000, 40_000_000)
    assert "11 steps of the time line, late by 30.00 ms in the median" in steps.in_words()


def test_a_new_time_line_may_count_from_now_or_go_on() -> None:
    for restart, due_ms in ((True, 1300.0), (False, 800.0)):
        clock = Clock()
        kernel = Watched(clock)
        shaper = netem(kernel, DirectionProfile(0.01), clock)
        shaper.follow_peer(PEER)
        for _ in range(5):
            shaper.step(0.1)
        shaper.follow_profile(
            DirectionProfile(0.02, changes=(Change(0.8, delay=0.09),)), restart=restart
        )
        for _ in range(12):
            shaper.step(0.1)
        assert [at for at, _, _ in kernel.history] == pytest.approx([500.0, due_ms])


def test_steps_that_change_nothing_ask_nothing_of_tc() -> None:
    changes = tuple(Change(0.1 * n, delay=0.02) for n in range(1, 6))
    kernel, steps = follow(DirectionProfile(0.02, changes=changes), 1.0)
    assert kernel.history == []
    assert steps.late == 0
