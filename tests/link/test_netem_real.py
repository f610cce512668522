"""netem in the kernel: asked, applied and measured between two network namespaces."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from numpy.typing import NDArray

from cloudrc.assembly import link_profile
from cloudrc.config.load import load_profile
from cloudrc.config.shipped import names
from cloudrc.errors import BadInputError, MissingPrerequisiteError
from cloudrc.link.model import LinkDirection, Numbers, Stream, numbers
from cloudrc.link.netem import STRETCH, Netem, check, table
from cloudrc.link.profile import Blackout, Change, DirectionProfile, GilbertElliott, Trace
from cloudrc.tunnel.codec import Kind
from tests.link import conftest as lab
from tests.link.conftest import SIZE, WITHIN, Flow, least, measure, show

SHAPED = [name for name in names("profile") if name != "lossy"]
"""netem refuses that one."""
MINUTES = [
    (name, way)
    for name in SHAPED
    for way in ("uplink", "downlink")
    if way == "uplink" or load_profile(name).downlink != load_profile(name).uplink
]
"""Every direction that ships, once: most profiles have the same both ways."""
Distribution = Literal["uniform", "normal", "pareto"]
Floats = NDArray[np.float64]
pytestmark = pytest.mark.netem


@pytest.mark.smoke
def test_the_delay_is_applied_to_the_tunnels_flow_alone(shaped: Netem) -> None:
    shaped.follow_profile(DirectionProfile(delay=0.060))

    def off() -> float:
        tunnel, stranger = Flow(), Flow(port=7402)
        tunnel.send(200, meanwhile=lambda: stranger.send(1, 0.0))
        delay, other = np.median(tunnel.settle().delays()), np.median(stranger.settle().delays())
        show("60 ms asked", tunnel=delay, other_port=other)
        assert other < 0.020
        return float(abs(delay - other - 0.060))

    assert least(off, WITHIN) < WITHIN
    assert min(connect() for _ in range(10)) < 0.020, "another protocol to the same port"


def connect() -> float:
    """Time to connect by TCP to the tunnel's own port [s]."""
    with lab.inside(lab.FAR):
        server = socket.create_server(lab.FAR_PEER)
    with lab.inside(lab.NEAR):
        client = socket.socket()
    with server, client:
        client.settimeout(5.0)
        began = time.monotonic()
        client.connect(lab.FAR_PEER)
        return time.monotonic() - began


@pytest.mark.parametrize("distribution", ["uniform", "normal", "pareto"])
def test_jitter_is_distributed_as_asked(shaped: Netem, distribution: Distribution) -> None:
    profile = DirectionProfile(delay=0.080, jitter=0.020)
    shaped.follow_profile(replace(profile, distribution="normal"))
    shaped.follow_profile(replace(profile, distribution=distribution))
    shares = [0.05, 0.25, 0.5, 0.75, 0.95]
    unit = 0.020 * STRETCH[distribution] / 8192
    asked = 0.080 + unit * np.quantile(table(distribution), shares)

    def off() -> float:
        delays = measure(800, 0.004).delays()
        error = np.abs(np.quantile(delays, shares) - asked).max()
        show(distribution, mean=delays.mean(), deviation=delays.std(), quantile_off=error)
        return float(error)

    assert least(off, 0.006) < 0.006


def test_losses_are_as_many_as_asked_and_counted(shaped: Netem) -> None:
    shaped.follow_profile(DirectionProfile(loss=0.2))
    flow = measure(1500, 0.002)
    counts = shaped.counts()
    show("loss 0.2 asked", measured=1 - len(flow.arrived) / 1500)
    assert counts["forwarded"] == len(flow.arrived)
    assert counts["forwarded"] + counts["lost"] == 1500
    assert counts["lost"] / 1500 == pytest.approx(0.2, abs=5 * (0.2 * 0.8 / 1500) ** 0.5)


def test_losses_come_in_bursts(shaped: Netem) -> None:
    shaped.follow_profile(DirectionProfile(loss=GilbertElliott(0.05, 0.25)))
    flow = measure(2000, 0.002)
    lost = sorted(set(range(2000)) - set(flow.numbers()))
    bursts = 1 + sum(after - before > 1 for before, after in pairwise(lost))
    show("gemodel", loss=len(lost) / 2000, burst=len(lost) / bursts)
    assert len(lost) / 2000 == pytest.approx(1 / 6, abs=0.07)
    assert 2.5 < len(lost) / bursts < 6.5


@pytest.mark.full
@pytest.mark.parametrize(("name", "way"), MINUTES)
def test_a_shipped_profile_for_a_minute(
    shaped: Netem, name: str, way: str, figure: Callable[..., None]
) -> None:
    """Mean, loss and order are those that the model draws for the same instants of sending."""
    profile = link_profile(getattr(load_profile(name), way))
    found: list[Flow] = []
    drawn: list[Numbers] = []

    def off() -> float:
        tunnel, stranger = Flow(), Flow(port=7402)
        sending = (6000, 0.01, lambda: stranger.send(1, 0.0))
        sender = threading.Thread(target=tunnel.send, args=sending)
        shaped.follow_profile(profile, restart=True)
        sender.start()
        while sender.is_alive():
            shaped.step(0.1)  # as a link's process does, whether there is a time line or not
        found[:] = [tunnel.settle()]
        drawn[:] = [drawn_for(tunnel, profile, seed) for seed in range(20)]
        beside, mean = stranger.settle().delays().mean(), tunnel.delays().mean()
        asked = float(np.mean([each.mean for each in drawn]))
        show(f"{name}, {way}, for a minute", asked=asked, measured=mean, other_port=beside)
        return float(abs(mean - beside - asked))

    error = least(off, WITHIN)
    figure("netem, a minute of a profile: mean off by", 1e3 * error, "<=", 1e3 * WITHIN, "ms")
    assert error <= WITHIN
    order = np.array(found[0].numbers())
    loss = 1 - len(set(found[0].numbers())) / 6000
    overtaken = float(np.mean(np.maximum.accumulate(order)[:-1] > order[1:]))
    for what, measured in (("loss", loss), ("overtaken", overtaken)):
        values = np.array([getattr(each, what) for each in drawn])
        show(f"{name}, {way}: {what}", asked=values.mean(), measured=measured)
        assert abs(measured - values.mean()) <= 5 * values.std() + 0.003, what


def drawn_for(flow: Flow, profile: DirectionProfile, seed: int) -> Numbers:
    """What the model does to packets that are sent when those of a flow were."""
    sent_ns = [at_ns - flow.sent_ns[0] for at_ns in flow.sent_ns]
    model = LinkDirection(profile, seed, True)
    fates = [model.send(1, int(Kind.TELEMETRY), n, SIZE, at_ns) for n, at_ns in enumerate(sent_ns)]
    delays = [
        (min(f) - at_ns) * 1e-9 if f else np.nan for f, at_ns in zip(fates, sent_ns, strict=True)
    ]
    copies = np.array([len(fate) for fate in fates])
    return numbers(Stream(np.array(sent_ns) * 1e-9, np.array(delays), copies))


def test_a_change_in_flight_loses_nothing(shaped: Netem) -> None:
    asked = [DirectionProfile(delay) for delay in (0.3, 0.02, 0.15, 0.05, 0.2)]
    asked[1] = replace(asked[1], rate=1e6, queue_packets=5)  # less room than what is under way
    asked[2] = replace(asked[2], jitter=0.02, distribution="normal")
    asked[3] = replace(asked[3], rate=2e6)
    flow = Flow()
    for profile in asked:
        flow.send(60, 0.005)
        shaped.follow_profile(profile)
    flow.send(60, 0.005)
    assert sorted(flow.settle().numbers()) == list(range(360))
    assert flow.delays()[:30].max() < 0.050
    assert np.median(flow.delays()[-30:]) == pytest.approx(0.2, abs=0.010)
    assert shaped.counts()["lost"] == 0


def test_the_order_is_kept_where_asked(shaped: Netem) -> None:
    profile = DirectionProfile(delay=0.040, jitter=0.030)
    for keep_order in (False, True, False):
        shaped.follow_profile(replace(profile, keep_order=keep_order))
        numbers = measure(300, 0.003).numbers()
        assert (numbers == sorted(numbers)) is keep_order
        assert len(numbers) == 300


def test_a_bottleneck_has_its_rate(shaped: Netem) -> None:
    shaped.follow_profile(DirectionProfile(rate=400e3, queue_packets=1000))

    def off() -> float:
        flow = Flow()
        flow.send(100, 0.0)
        flow.settle()
        took = (flow.arrived[-1][1] - flow.arrived[0][1]) * 1e-9
        measured = 99 * 200 * 8 / took  # 172 bytes and 28 of headers
        show("400 kbit/s asked", measured=measured)
        return abs(measured / 400e3 - 1.0)

    assert least(off, 0.03) < 0.03


def test_duplicates_and_packets_that_overtake(shaped: Netem) -> None:
    shaped.follow_profile(DirectionProfile(delay=0.050, duplicate=0.3))
    numbers = measure(500, 0.003).numbers()
    assert (len(numbers) - 500) / 500 == pytest.approx(0.3, abs=0.11)
    shaped.follow_profile(DirectionProfile(delay=0.050, reorder=0.3))
    early = (measure(500, 0.003).delays() < 0.030).mean()
    assert early == pytest.approx(0.3, abs=0.11)


def test_it_is_set_up_once_and_removed_without_a_trace(tables: Path) -> None:
    before = lab.qdiscs()
    first = lab.real_netem(tables, DirectionProfile(0.02))
    first.follow_peer(("10.79.0.9", 7400))  # killed here: its qdiscs stay
    left = lab.qdiscs()
    second = lab.real_netem(tables, DirectionProfile(0.05))
    for peer in (lab.FAR_PEER, lab.FAR_PEER, ("10.79.0.7", 7400), lab.FAR_PEER):
        second.follow_peer(peer)
    assert lab.qdiscs().count("netem") == left.count("netem") == 1
    filters = lab.sh("tc", "-n", lab.NEAR, "filter", "show", "dev", lab.DEVICE, "parent", "7400:")
    assert filters.count("flowid 7400:4") == 1
    assert np.median(measure(50).delays()) == pytest.approx(0.05, abs=0.01)
    second.close()
    second.close()
    assert lab.qdiscs() == before


@pytest.mark.parametrize(
    "words",
    [
        ("del", "dev", lab.DEVICE, "root"),
        ("del", "dev", lab.DEVICE, "parent", "7400:4"),
        ("change", "dev", lab.DEVICE, "parent", "7400:4", "handle", "7401:", "netem"),
    ],
    ids=["root", "leaf", "changed"],
)
def test_what_another_program_does_is_counted_once(tables: Path, words: tuple[str, ...]) -> None:
    shaped = lab.real_netem(tables, DirectionProfile(delay=0.060))
    shaped.follow_peer(lab.FAR_PEER)
    assert shaped.counts()["restored"] == 0
    lab.sh("tc", "-n", lab.NEAR, "qdisc", *words)
    for _ in range(2):
        shaped.step(1.1)
        assert shaped.counts()["restored"] == 1
    with pytest.raises(MissingPrerequisiteError, match="restart this pod"):
        shaped.follow_profile(DirectionProfile(delay=0.080))
    shaped.close()


@pytest.mark.parametrize("name", names("profile"))
def test_tc_takes_every_shipped_profile_that_is_not_refused(shaped: Netem, name: str) -> None:
    profile = link_profile(load_profile(name).uplink)
    try:
        check(profile)
    except BadInputError:
        assert name == "lossy"
        return
    shaped.follow_profile(profile)
    listed = json.loads(lab.sh("tc", "-n", lab.NEAR, "-j", "qdisc", "show", "dev", lab.DEVICE))
    options = next(one["options"] for one in listed if one["kind"] == "netem")
    assert options.get("delay", {"delay": 0})["delay"] == pytest.approx(profile.delay)


def test_a_long_queue_holds_what_the_rate_and_the_delay_need(shaped: Netem) -> None:
    """200 kbit/s and 300 ms: 38 packets of 200 bytes are under way beside the queue's 100."""
    shaped.follow_profile(DirectionProfile(delay=0.3, rate=200e3, queue_packets=100))
    flow = Flow()
    flow.send(130, 0.0)
    assert len(flow.settle().arrived) == 130
    flow = Flow()
    flow.send(800, 0.0)
    arrived = len(flow.settle(1.0).arrived)
    show("at once", sent=800, arrived=arrived)
    assert 138 <= arrived < 800


def test_a_measured_distribution_is_applied(tables: Path, shaped: Netem) -> None:
    drawn = np.random.default_rng(5).choice(
        [-1.0, -0.8, 1.6, 2.0], size=2000, p=[0.3, 0.3, 0.3, 0.1]
    )
    values = tuple(np.sort((drawn - drawn.mean()) / drawn.std()).tolist())
    profile = DirectionProfile(delay=0.1, jitter=0.03, distribution="table", table=values)
    shaped.follow_profile(profile)
    delays = measure(600, 0.004).delays()
    near = np.abs(delays[:, None] - (0.1 + 0.03 * np.unique(values))).min(axis=1)
    show("four delays asked", mean=delays.mean(), deviation=delays.std(), off=np.median(near))
    assert np.median(near) < WITHIN
    assert delays.std() == pytest.approx(0.03, abs=0.004)


def test_what_tc_clamps_is_refused_and_the_old_conditions_stay(shaped: Netem) -> None:
    shaped.follow_profile(DirectionProfile(delay=0.03))
    before = lab.qdiscs()
    with pytest.raises(BadInputError, match=r"rate: asked 0\.5, in force 0"):
        shaped.follow_profile(DirectionProfile(rate=4.0))
    with pytest.raises(BadInputError, match="loss: asked 1e-11, in force 0"):
        shaped.follow_profile(DirectionProfile(loss=1e-11))
    assert lab.qdiscs() == before


LATE = 0.1
"""Lateness of a step where the machine now and then stands still [s]."""


def stepped(tables: Path, profile: DirectionProfile, count: int) -> tuple[Netem, Flow, Floats]:
    """Follow a time line beside a flow of 50 Hz; also return the times of sending on it [s]."""
    origin_ns = time.monotonic_ns() + 5_000_000_000  # by then it is set up
    begun_ns = origin_ns + time.time_ns() - time.monotonic_ns()
    netem, flow = lab.real_netem(tables, profile, origin_ns), Flow()
    netem.follow_peer(lab.FAR_PEER)
    sender = threading.Thread(target=flow.send, args=(count, 0.02))
    sender.start()
    while sender.is_alive():
        netem.step(0.1)
    flow.settle()
    netem.close()
    return netem, flow, (np.array(flow.sent_ns) - begun_ns) * 1e-9


def test_changes_and_blackouts_take_effect_when_they_are_due(tables: Path) -> None:
    profile = DirectionProfile(
        delay=0.02, changes=(Change(2.5, delay=0.1),), blackouts=(Blackout(3.5, 0.3),)
    )
    netem, flow, since = stepped(tables, profile, 480)
    assert (netem.steps.counts()["steps"], netem.steps.counts()["steps_passed_over"]) == (3, 0)
    arrived, delays = since[flow.numbers()], flow.delays()
    lost = np.delete(since, flow.numbers())
    before, after = delays[arrived < 2.45], delays[arrived > 2.5 + LATE]
    show("step", before=np.median(before), after=np.median(after), dark=np.ptp(lost))
    assert np.median(before) == pytest.approx(0.02, abs=0.005)
    assert np.median(after) == pytest.approx(0.1, abs=0.005)
    assert (lost.min(), lost.max()) == pytest.approx((3.5, 3.8), abs=LATE)


def test_a_trace_is_followed(tables: Path) -> None:
    """60 to 140 ms in waves of 4 s, one row per 20 ms; measured at the instants of sending."""
    times = 0.02 * np.arange(400)
    rows = 0.1 + 0.04 * np.sin(0.5 * np.pi * times)
    profile = DirectionProfile(trace=Trace(tuple(times.tolist()), tuple(rows.tolist())))

    def off() -> float:
        netem, flow, since = stepped(tables, profile, 700)
        assert len(flow.arrived) == 700, "steps lose nothing"
        on = (since[flow.numbers()] > 0.0) & (since[flow.numbers()] < times[-1])
        asked = rows[np.searchsorted(times, since[flow.numbers()][on], side="right") - 1]
        correlation = float(np.corrcoef(asked, flow.delays()[on])[0, 1])
        show(netem.steps.in_words(), correlation=correlation)
        assert (
            netem.steps.counts()["steps"] + netem.steps.counts()["steps_passed_over"]
            == len(times) - 1
        )
        return 1.0 - correlation

    assert least(off, 0.02) < 0.02
