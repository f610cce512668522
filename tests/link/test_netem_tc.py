"""How netem is set up, found again, changed and removed: tc's side played by a small kernel."""

from __future__ import annotations

import json

import pytest

from cloudrc.errors import BadInputError, MissingPrerequisiteError
from cloudrc.link.netem import counters
from cloudrc.link.profile import Change, DirectionProfile, Trace
from cloudrc.link.tc import Answer, explain, limit, may_shape, try_netem
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


def test_a_step_that_is_due_as_room_is_taken_back_is_counted() -> None:
    kernel, clock = Kernel(), Clock()
    shaper = netem(kernel, DirectionProfile(1.0, rate=1e6, queue_packets=10), clock)
    shaper.follow_peer(PEER)
    kernel.held = 100
    small = DirectionProfile(0.02, rate=1e6, queue_packets=10, changes=(Change(1.0, delay=0.05),))
    shaper.follow_profile(small)
    kernel.held, clock.now_ns = 3, 1_500_000_000
    shaper.step(0.1)
    assert f"limit {limit(small)} delay 50000.000us" in kernel.said[-1]
    assert shaper.steps.applied == 1


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


def test_what_is_refused_leaves_the_old_profile_in_force() -> None:
    kernel = Kernel()
    shaper = netem(kernel, DirectionProfile(0.04))
    shaper.follow_peer(PEER)
    before = kernel.netem
    with pytest.raises(BadInputError, match="delay_ms above 274000"):
        shaper.follow_profile(DirectionProfile(trace=Trace((0.0,), (300.0,))))
    shaper.step(0.1)
    assert kernel.netem == before


def test_what_the_kernel_clamps_is_refused_with_both_numbers() -> None:
    kernel = Kernel()
    shaper = netem(kernel, DirectionProfile(0.04))
    shaper.follow_peer(PEER)
    kernel.clamps = {"rate": {"rate": 0}}
    with pytest.raises(BadInputError, match=r"rate: asked 0.125, in force 0\); set link.mode"):
        shaper.follow_profile(DirectionProfile(0.04, rate=1.0))
    assert (kernel.netem or [])[-1] == "0bit"
    kernel = Kernel()
    kernel.clamps = {"limit": 1000}
    with pytest.raises(BadInputError, match="limit: asked 10000, in force 1000"):
        netem(kernel, DirectionProfile(0.04)).follow_peer(PEER)
    assert kernel.root["kind"] == "noqueue"


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
def test_a_kernel_without_netem_is_named_with_both_ways_out(lacks: tuple[str, ...]) -> None:
    kernel = Kernel(*lacks)
    with pytest.raises(MissingPrerequisiteError) as refused:
        netem(kernel, DirectionProfile(0.04)).follow_peer(PEER)
    assert str(refused.value) == (
        "this kernel has no sch_netem; set link.mode=relay, which needs nothing of the kernel, or "
        "use nodes whose kernel has it ('modprobe sch_netem' there) and a namespace for privileged "
        "pods"
    )
    assert kernel.root["kind"] == "noqueue"


def test_netem_is_tried_on_the_loopback_and_leaves_nothing_there() -> None:
    for left in ("noqueue", "netem"):
        kernel = Kernel()
        if left == "netem":  # a trial that was killed
            kernel.root = {"kind": "netem", "handle": "7402:", "root": True}
        try_netem(kernel.run)
        assert kernel.root["kind"] == "noqueue"
    with pytest.raises(MissingPrerequisiteError, match="this kernel has no sch_netem"):
        try_netem(Kernel("netem").run)
    kernel.root = {"kind": "tbf", "handle": "8001:", "root": True}
    try_netem(kernel.run)
    assert kernel.root["kind"] == "tbf"


def test_flower_stands_in_for_u32_and_neither_is_said() -> None:
    kernel = Kernel("u32")
    netem(kernel, DirectionProfile(0.04)).follow_peer(PEER)
    assert kernel.filters == {
        1: "protocol ip flower ip_proto udp dst_ip 10.244.0.7 dst_port 7400 classid 7400:4"
    }
    kernel = Kernel("u32", "flower")
    with pytest.raises(MissingPrerequisiteError, match="neither cls_u32 nor cls_flower"):
        netem(kernel, DirectionProfile(0.04)).follow_peer(PEER)
    assert kernel.root["kind"] == "noqueue"


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (Answer(127, "", ""), "no program tc (package iproute2)"),
        (Answer(2, "", "RTNETLINK answers: Operation not permitted\n"), "NET_ADMIN and uid 0"),
        (Answer(2, "", "RTNETLINK answers: No such file or directory"), "has no sch_netem;"),
        (Answer(1, "", 'Illegal "latency"\n'), "'tc qdisc add netem' failed: Illegal \"latency\""),
        (Answer(3, "", ""), "exit code 3"),
    ],
)
def test_what_tc_says_becomes_one_sentence(answer: Answer, words: str) -> None:
    text = str(explain("tc", ("qdisc", "add", "netem"), answer))
    assert words in text
    assert "link.mode=relay" in text
    assert "\n" not in text


@pytest.mark.parametrize(
    ("uid", "capabilities", "may"),
    [
        ("0\t0\t0\t0", "000001ffffffffff", True),
        ("0\t0\t0\t0", "0000000000001000", True),
        ("0\t0\t0\t0", "00000000a80425fb", False),  # what a container has by default
        ("10001\t10001\t10001\t10001", "0000000000001000", False),
    ],
)
def test_root_with_the_capability_may_shape(uid: str, capabilities: str, may: bool) -> None:
    status = f"Name:\tpython\nUid:\t{uid}\nCapPrm:\t0\nCapEff:\t{capabilities}\n"
    assert may_shape(status) is may
    assert not may_shape("")


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
