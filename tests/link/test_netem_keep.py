"""What another hand does to the qdiscs is seen within a second, put back, logged and counted."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import pytest

from cloudrc.errors import MissingPrerequisiteError
from cloudrc.link.netem import FILTER_LOOKS, Netem
from cloudrc.link.profile import Change, DirectionProfile
from cloudrc.link.tc import Answer
from tests.link.conftest import PEER, Clock, Kernel

PROFILE = DirectionProfile(0.04, loss=0.1)


class Bench:
    """A netem in force, on a clock that only it moves."""

    def __init__(self, profile: DirectionProfile = PROFILE) -> None:
        self.kernel, self.clock, self.log = Kernel(), Clock(), list[str]()
        self.netem = Netem(
            self.kernel.run,
            profile,
            origin_ns=0,
            clock=self.clock,
            wait=self.clock.wait,
            log=self.log.append,
        )
        self.netem.follow_peer(PEER)
        self.step(2.0)
        self.whole = self.state()
        self.kernel.said.clear()

    def step(self, duration: float) -> None:
        until_ns = self.clock.now_ns + round(duration * 1e9)
        while self.clock.now_ns < until_ns:
            self.netem.step(0.1)

    def state(self) -> tuple[object, ...]:
        kernel = self.kernel
        return kernel.root, tuple(kernel.netem or ()), sorted(kernel.filters.values())

    @property
    def restored(self) -> int:
        return self.netem.counts()["restored"]


def remove_all(kernel: Kernel) -> None:
    kernel._clear()


def remove_leaf(kernel: Kernel) -> None:
    kernel.netem = None


def take_the_delay_out(kernel: Kernel) -> None:
    assert kernel.netem is not None
    kernel.netem[kernel.netem.index("delay") + 1] = "0.000us"


@pytest.mark.parametrize(
    ("damage", "word"),
    [
        (remove_all, "eth0 was removed by another hand, and put back (1 times so far)"),
        (remove_leaf, "eth0 was removed by another hand"),
        (take_the_delay_out, "was changed (delay delay: asked 0.04, in force 0) by another hand"),
    ],
)
def test_it_is_put_back_within_a_second_and_said_once(
    damage: Callable[[Kernel], None], word: str
) -> None:
    bench = Bench()
    damage(bench.kernel)
    bench.step(1.1)
    assert bench.state() == bench.whole
    bench.step(5.0)
    (line,) = bench.log
    assert word in line
    assert bench.restored == 1


def test_where_nothing_happens_nothing_is_asked_but_a_listing() -> None:
    bench = Bench()
    bench.step(20.0)
    assert bench.kernel.said == []
    assert (bench.log, bench.restored) == ([], 0)


def test_a_filter_that_is_gone_is_put_back() -> None:
    bench = Bench()
    bench.kernel.filters.clear()
    bench.step(FILTER_LOOKS + 1.0)
    assert bench.state() == bench.whole
    assert "lost its filter by another hand" in bench.log[0]
    assert bench.restored == 1


def test_a_qdisc_of_somebody_else_stays_and_that_is_said_once() -> None:
    bench = Bench()
    bench.kernel._clear()
    theirs = {"kind": "fq", "handle": "8001:", "root": True}
    bench.kernel.root = theirs
    bench.step(5.0)
    (line,) = bench.log
    assert "cannot be put back: eth0 has a qdisc already (fq 8001:)" in line
    assert (bench.kernel.root, bench.restored) == (theirs, 0)
    bench.kernel._clear()
    bench.step(1.1)
    assert bench.state() == bench.whole
    assert bench.restored == 1


def test_a_time_line_goes_on_over_a_qdisc_that_was_removed() -> None:
    bench = Bench(DirectionProfile(0.04, changes=(Change(2.3, delay=0.2),)))
    bench.kernel._clear()
    bench.step(0.5)
    assert bench.kernel.netem is not None
    assert "200000.000us" in bench.kernel.netem
    assert bench.restored == 1


@pytest.mark.parametrize("damage", [remove_all, remove_leaf])
@pytest.mark.parametrize("profile", [PROFILE, DirectionProfile(0.07)])
def test_a_profile_after_a_removal_is_in_force_at_once(
    damage: Callable[[Kernel], None], profile: DirectionProfile
) -> None:
    bench = Bench()
    damage(bench.kernel)
    bench.netem.follow_profile(profile)
    assert f"{profile.delay * 1e6:.3f}us" in (bench.kernel.netem or [])
    assert bench.state()[2] == bench.whole[2]
    assert bench.restored == 1


def test_a_profile_is_refused_if_the_qdisc_goes_during_the_check() -> None:
    bench = Bench()
    run = bench.kernel.run

    def gone_once_it_is_changed(words: Sequence[str]) -> Answer:
        answer = run(words)
        if "change" in words and not bench.log:
            bench.kernel._clear()
        return answer

    bench.netem._iproute2._run = gone_once_it_is_changed
    with pytest.raises(MissingPrerequisiteError, match="eth0 was removed by another hand"):
        bench.netem.follow_profile(DirectionProfile(0.07))
    assert bench.state() == bench.whole


def test_what_was_counted_before_is_kept() -> None:
    bench = Bench()
    before = bench.netem.counts()
    bench.kernel._clear()
    assert bench.netem.counts()["forwarded"] == before["forwarded"]
    after = bench.netem.counts()
    assert after["forwarded"] == 2 * before["forwarded"], "the new qdisc has counted as many"
    assert after["restored"] == 1


def test_nothing_is_put_back_once_it_is_closed() -> None:
    bench = Bench()
    bench.netem.close()
    bench.netem._look(bench.kernel.qdiscs())
    assert bench.kernel.netem is None
    assert bench.log == []
