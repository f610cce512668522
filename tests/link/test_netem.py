"""netem is set up, found again, changed, stepped and removed; a fake kernel answers for tc."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence

import pytest

from cloudrc.errors import BadInputError, MissingPrerequisiteError
from cloudrc.link.netem import Answer, Steps, counters, differences, limit, options
from cloudrc.link.profile import Blackout, Change, DirectionProfile, GilbertElliott, Trace
from tests.link.conftest import PEER, Clock, Kernel, netem


def test_only_the_tunnels_flow_to_the_peer_is_sent_to_netem() -> None:
    kernel = Kernel()
    assert netem(kernel, DirectionProfile(0.04)).follow_peer(PEER) == PEER
    assert kernel.said == [
        "qdisc add root handle 7400: prio bands 4 priomap 1 2 2 2 1 2 0 0 1 1 1 1 1 1 1 1",
        "qdisc add parent 7400:4 handle 7401: netem limit 10000 delay 40000.000us loss random 0% "
        "duplicate 0% corrupt 0% rate 0bit",
        "filter add parent 7400: pref 1 protocol ip u32 match ip protocol 17 0xff "
        "match ip dst 10.244.0.7/32 match ip dport 7400 0xffff flowid 7400:4",
    ]


def test_the_set_up_of_a_killed_process_is_taken_over() -> None:
    kernel = Kernel()
    netem(kernel, DirectionProfile(0.04)).follow_peer(PEER)
    kernel.said.clear()
    netem(kernel, DirectionProfile(0.07)).follow_peer(PEER)
    assert [line.split(" pref")[0][:40] for line in kernel.said] == [
        "qdisc change parent 7400:4 handle 7401: ",
        "filter add parent 7400:",
        "filter del parent 7400:",
    ]
    assert len(kernel.filters) == 1


def test_a_new_address_gets_its_filter_before_the_old_one_goes() -> None:
    kernel = Kernel()
    shaper = netem(kernel, DirectionProfile(0.04))
    for last in (7, 8, 9, 9):
        shaper.follow_peer((f"10.244.0.{last}", 7400))
        (match,) = kernel.filters.values()
        assert f"10.244.0.{last}/32" in match
    assert [line.split()[1] for line in kernel.said[3:5]] == ["add", "del"]


def test_what_is_under_way_has_room_until_it_has_left() -> None:
    kernel, clock = Kernel(), Clock()
    shaper = netem(kernel, DirectionProfile(1.0, rate=1e6, queue_packets=10), clock)
    shaper.follow_peer(PEER)
    kernel.held = 100
    small = DirectionProfile(0.02, rate=1e6, queue_packets=10)
    shaper.follow_profile(small)
    assert f"limit {limit(small) + 100} " in kernel.said[-1]
    shaper.step(1.5)
    assert f"limit {limit(small) + 100} " in kernel.said[-1]
    kernel.held = 3
    for _ in range(2):
        shaper.step(1.0)
    assert f"limit {limit(small)} " in kernel.said[-1]


def test_a_change_is_a_change_and_the_same_again_is_nothing() -> None:
    kernel = Kernel()
    shaper = netem(kernel, DirectionProfile(0.04))
    shaper.follow_peer(PEER)
    kernel.said.clear()
    shaper.follow_profile(DirectionProfile(0.04))
    shaper.step(0.1)
    assert kernel.said == []
    shaper.follow_profile(DirectionProfile(0.05))
    assert len(kernel.said) == 1
    assert kernel.said[0].startswith("qdisc change parent 7400:4 handle 7401: netem")


@pytest.mark.parametrize(
    ("asked", "clamps", "words"),
    [
        (DirectionProfile(trace=Trace((0.0,), (300.0,))), {}, "delay_ms above 274000"),
        (DirectionProfile(0.04, rate=1.0), {"rate": {"rate": 0}}, "rate: asked 0.125, in force 0"),
    ],
)
def test_what_is_refused_leaves_the_old_profile_in_force(
    asked: DirectionProfile, clamps: dict[str, object], words: str
) -> None:
    kernel = Kernel()
    shaper = netem(kernel, DirectionProfile(0.04))
    shaper.follow_peer(PEER)
    before, kernel.clamps = kernel.netem, clamps
    with pytest.raises(BadInputError, match=words):
        shaper.follow_profile(asked)
    shaper.step(0.1)
    assert kernel.netem == before


def test_a_first_profile_that_is_clamped_leaves_nothing_behind() -> None:
    kernel = Kernel()
    kernel.clamps = {"limit": 1000}
    with pytest.raises(BadInputError, match="limit: asked 10000, in force 1000"):
        netem(kernel, DirectionProfile(0.04)).follow_peer(PEER)
    assert kernel.root["kind"] == "noqueue"


def test_every_number_in_force_is_compared() -> None:
    profile = DirectionProfile(
        0.04, 0.01, "pareto", 0.3, GilbertElliott(0.01, 0.1, 0.6, 0.005), 0.02, 0.1, corrupt=0.005,
        rate=2e6,
    )  # fmt: skip
    words = options(profile, netem(Kernel(), profile)._timeline.at(0), 500)
    told = {
        "limit": 500,
        "delay": {"delay": 0.04, "jitter": 0.04, "correlation": 0.3},
        "loss-gemodel": {"p": 0.01, "r": 0.1, "1-h": 0.6, "1-k": 0.005},
        "duplicate": {"duplicate": 0.02},
        "corrupt": {"corrupt": 0.005},
        "reorder": {"reorder": 0.1},
        "rate": {"rate": 250_000, "packetoverhead": 4294967282},
    }
    assert differences(words, told) == []
    found = [one.partition(":")[0] for one in differences(words, {})]
    assert found == [
        *("limit", "delay delay", "delay jitter", "delay correlation"),
        *("gemodel p", "gemodel r", "gemodel 1-h", "gemodel 1-k"),
        *("duplicate", "corrupt", "reorder", "rate"),
    ]


def test_closing_removes_it_once_and_only_what_is_ours() -> None:
    kernel = Kernel()
    shaper = netem(kernel, DirectionProfile(0.04))
    shaper.follow_peer(PEER)
    shaper.close()
    shaper.close()
    assert kernel.said[3:] == ["qdisc del root"]


def test_a_qdisc_of_somebody_else_is_left_alone() -> None:
    kernel = Kernel()
    kernel.root = {"kind": "tbf", "handle": "8001:", "root": True}
    with pytest.raises(MissingPrerequisiteError, match=r"eth0 has a qdisc already \(tbf 8001:\)"):
        netem(kernel, DirectionProfile(0.04)).follow_peer(PEER)
    assert kernel.said == []


@pytest.mark.parametrize("lacks", [("netem",), ("netem", "prio")])
def test_a_kernel_without_netem_is_named(lacks: tuple[str, ...]) -> None:
    kernel = Kernel(*lacks)
    with pytest.raises(MissingPrerequisiteError, match="this kernel has no sch_netem; set link"):
        netem(kernel, DirectionProfile(0.04)).follow_peer(PEER)
    assert kernel.root["kind"] == "noqueue"


def test_flower_stands_in_for_u32_and_neither_is_an_error() -> None:
    kernel = Kernel("u32")
    netem(kernel, DirectionProfile(0.04)).follow_peer(PEER)
    assert kernel.filters == {
        1: "protocol ip flower ip_proto udp dst_ip 10.244.0.7 dst_port 7400 classid 7400:4"
    }
    kernel = Kernel("u32", "flower")
    with pytest.raises(MissingPrerequisiteError, match="neither cls_u32 nor cls_flower"):
        netem(kernel, DirectionProfile(0.04)).follow_peer(PEER)
    assert kernel.root["kind"] == "noqueue"


def remove_all(kernel: Kernel) -> None:
    kernel._clear()


def remove_leaf(kernel: Kernel) -> None:
    kernel.netem = None


def take_the_delay_out(kernel: Kernel) -> None:
    assert kernel.netem is not None
    kernel.netem[kernel.netem.index("delay") + 1] = "0.000us"


@pytest.mark.parametrize(
    ("harm", "words"),
    [
        (remove_all, "was removed by another program"),
        (remove_leaf, "was removed by another program"),
        (take_the_delay_out, "was changed (delay delay: asked 0.04, in force 0) by another"),
    ],
)
def test_a_foreign_change_is_an_error_and_not_repaired(
    harm: Callable[[Kernel], None], words: str
) -> None:
    kernel, clock, log = Kernel(), Clock(), list[str]()
    profile = DirectionProfile(0.04, changes=(Change(5.0, loss=0.1), Change(9.0, delay=0.2)))
    shaper = netem(kernel, profile, clock, log.append)
    shaper.follow_peer(PEER)
    shaper.step(1.5)
    assert (log, shaper.counts()["restored"]) == ([], 0)
    harm(kernel)
    kernel.said.clear()
    shaper.step(1.0)
    assert log == []
    shaper.step(1.0)
    (line,) = log
    assert line.startswith(f"error: the qdisc of eth0 {words}")
    assert kernel.said == []
    if harm is not take_the_delay_out:
        for _ in range(80):
            shaper.step(0.1)
        with pytest.raises(MissingPrerequisiteError, match="restart this pod"):
            shaper.follow_profile(DirectionProfile(0.07))
    assert len([one for one in log if one.startswith("error")]) == 1, "said once"
    assert shaper.counts()["restored"] == 1


def test_a_qdisc_that_goes_while_a_profile_is_applied_is_named() -> None:
    kernel = Kernel()
    shaper = netem(kernel, DirectionProfile(0.04))
    shaper.follow_peer(PEER)
    run = kernel.run

    def gone_once_it_is_changed(words: Sequence[str]) -> Answer:
        answer = run(words)
        if "change" in words:
            kernel._clear()
        return answer

    shaper._iproute2._run = gone_once_it_is_changed
    with pytest.raises(MissingPrerequisiteError, match="eth0 was removed by another program"):
        shaper.follow_profile(DirectionProfile(0.07))


class Watched(Kernel):
    """Notes from when on [ms] which delay [us] and loss were in force."""

    def __init__(self, clock: Clock, slow_ms: int = 0) -> None:
        super().__init__()
        self.clock, self.slow_ms, self.history = clock, slow_ms, list[tuple[float, str, str]]()

    def run(self, words: Sequence[str]) -> Answer:
        answer = super().run(words)
        if "change" in words:
            self.clock.now_ns += self.slow_ms * 1_000_000
            at = list(words).index("delay")
            loss = words[list(words).index("loss") + 2]
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


def test_a_step_is_taken_when_it_is_due() -> None:
    profile = DirectionProfile(
        delay=0.02, changes=(Change(1.003, delay=0.1),), blackouts=(Blackout(1.511, 0.05),)
    )
    kernel, steps = follow(profile, 2.0)
    assert kernel.history == [
        (pytest.approx(1003.0), "100000.000us", "0%"),
        (pytest.approx(1511.0), "100000.000us", "100%"),
        (pytest.approx(1561.0), "100000.000us", "0%"),
    ]
    assert (
        steps.counts()["steps"],
        steps.counts()["steps_late"],
        steps.counts()["steps_passed_over"],
    ) == (3, 0, 0)


def test_changes_faster_than_the_step_are_skipped_and_counted() -> None:
    times = tuple(0.001 * n for n in range(1000))
    trace = Trace(times, tuple(0.03 + 1e-5 * n for n in range(1000)))
    kernel, steps = follow(DirectionProfile(trace=trace), 1.2)
    gaps = [b[0] - a[0] for a, b in zip(kernel.history, kernel.history[1:], strict=False)]
    assert min(gaps) >= 4.999
    assert steps.counts()["steps"] + steps.counts()["steps_passed_over"] == 999
    assert steps.counts()["steps"] >= 199
    assert kernel.history[-1][1] == "39990.000us"


def test_a_slow_machine_reports_its_lateness() -> None:
    changes = tuple(Change(0.1 * n, delay=0.01 * n) for n in range(1, 11))
    _, steps = follow(DirectionProfile(changes=changes), 1.5, slow_ms=30)
    assert (steps.counts()["steps"], steps.counts()["steps_late"]) == (10, 10)
    steps.note(40_000_000, 0)
    assert list(steps.counts().values())[-2:] == [30_000_000, 40_000_000]
    assert "11 steps of the time line, late by 30.00 ms in the median" in steps.in_words()


@pytest.mark.parametrize(("restart", "due_ms"), [(True, 1300.0), (False, 800.0)])
def test_a_new_time_line_may_count_from_now_or_go_on(restart: bool, due_ms: float) -> None:
    clock = Clock()
    kernel = Watched(clock)
    shaper = netem(kernel, DirectionProfile(0.01), clock)
    shaper.follow_peer(PEER)
    shaper.step(0.5)
    after = DirectionProfile(0.02, changes=(Change(0.8, delay=0.09),))
    shaper.follow_profile(after, restart=restart)
    shaper.step(1.2)
    assert [at for at, _, _ in kernel.history] == pytest.approx([500.0, due_ms])


def test_steps_that_change_nothing_ask_nothing_of_tc() -> None:
    changes = tuple(Change(0.1 * n, delay=0.02) for n in range(1, 6))
    kernel, steps = follow(DirectionProfile(0.02, changes=changes), 1.0)
    assert kernel.history == []
    assert steps.counts()["steps_late"] == 0


# As iproute2 6.1 prints it for Linux 6.1.
LISTED = """[{"kind":"prio","handle":"7400:","root":true,"refcnt":3,"options":{"bands":4,"priomap":
[1,2,2,2,1,2,0,0,1,1,1,1,1,1,1,1],"multiqueue":false},"bytes":160,"packets":2,"drops":0,
"overlimits":0,"requeues":0,"backlog":0,"qlen":0},{"kind":"netem","handle":"7401:","parent":
"7400:4","options":{"limit":1000,"delay":{"delay":0.01,"jitter":0.005,"correlation":0.3},
"ecn":false,"gap":0},"bytes":2000,"packets":10,"drops":3,"overlimits":0,"requeues":0,"backlog":428,
"qlen":2}]"""


def test_counters_are_read_from_tcs_json() -> None:
    assert counters(json.loads(LISTED)) == {"forwarded": 10, "lost": 3, "held": 2}
    assert counters(json.loads('[{"kind":"noqueue","handle":"0:","root":true}]')) == {}
