"""One direction of the link: pure draws, queue, order, time line."""

from __future__ import annotations

import random
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cloudrc.link.model import LinkDirection
from cloudrc.link.profile import Blackout, Change, DirectionProfile, GilbertElliott, Trace
from tests.link.conftest import MS, PERIOD_NS, SIZE, TELEMETRY, flow, link

SECOND = 1_000_000_000
LIVELY = DirectionProfile(
    0.045,
    0.025,
    "pareto",
    0.5,
    GilbertElliott(0.02, 0.2, 0.5, 0.01, 0.03),
    duplicate=0.05,
    reorder=0.05,
)
profiles = st.builds(
    DirectionProfile,
    delay=st.floats(0, 0.5),
    jitter=st.floats(0, 0.5),
    distribution=st.sampled_from(["uniform", "normal", "pareto"]),
    correlation=st.sampled_from([0.0, 0.5, 1.0]),
    loss=st.sampled_from([0.0, 0.3, GilbertElliott(0.1, 0.3, 0.5, 0.1, 0.1)]),
    duplicate=st.sampled_from([0.0, 0.5]),
    reorder=st.sampled_from([0.0, 0.5]),
    keep_order=st.booleans(),
    rate=st.sampled_from([None, 1e5]),
    queue_packets=st.sampled_from([1, 10]),
    changes=st.sampled_from([(), (Change(0.5, 0.01, 0.02, 0.1, 1e6), Change(1.0, loss=0.0))]),
    blackouts=st.sampled_from([(), (Blackout(0.2, 0.1),)]),
)


def ask(direction: LinkDirection, counters: list[int]) -> dict[int, tuple[int, ...]]:
    return {n: direction.send(1, TELEMETRY, n, SIZE, n * PERIOD_NS) for n in counters}


@given(profile=profiles, seed=st.integers(0, 2**63 - 1))
@settings(max_examples=40, deadline=None)
def test_nothing_is_early_and_every_packet_is_counted_once(
    profile: DirectionProfile, seed: int
) -> None:
    direction = link(profile, seed)
    fates = [direction.send(1, 3, n, SIZE, n * 5 * MS) for n in range(400)]
    for n, releases in enumerate(fates):
        assert len(releases) <= 2
        assert all(type(r) is int and r >= n * 5 * MS for r in releases)
    counts = direction.counts()
    assert counts.pop("duplicated") == sum(len(releases) == 2 for releases in fates)
    assert sum(counts.values()) == 400
    assert counts["passed"] == sum(bool(releases) for releases in fates)


@given(profile=profiles)
@settings(max_examples=20, deadline=None)
def test_keep_order_keeps_the_order(profile: DirectionProfile) -> None:
    direction = link(replace(profile, keep_order=True))
    releases = [r for n in range(400) for r in direction.send(1, 3, n, SIZE, n * 5 * MS)]
    assert releases == sorted(releases)


@pytest.mark.parametrize(
    "profile", [LIVELY, DirectionProfile(0.01, 0.01, changes=(Change(10.0, 0.02, loss=0.2),))]
)
def test_the_order_of_asking_does_not_matter(profile: DirectionProfile) -> None:
    counters = [*range(3000), *range(100_000, 101_000)]
    shuffled = random.Random(1).sample(counters, len(counters))
    assert ask(link(profile), shuffled) == ask(link(profile), counters)


def test_threads_do_not_matter() -> None:
    counters = list(range(2000))
    with ThreadPoolExecutor(4) as pool:
        answers = list(pool.map(lambda _: ask(link(LIVELY), counters), range(4)))
    assert answers == [ask(link(LIVELY), counters)] * 4


@pytest.mark.promise("link-follows-the-seed")
def test_other_kinds_and_epochs_shift_nothing() -> None:
    alone, among = link(LIVELY), link(LIVELY)
    for n in range(1000):
        for kind, epoch in ((1, 0), (1, 1), (3, 2)):
            among.send(epoch, kind, n, 40, n * PERIOD_NS)
        assert among.send(1, 3, n, SIZE, n) == alone.send(1, 3, n, SIZE, n)


def test_directions_and_seeds_differ() -> None:
    counters = list(range(100))
    fates = [ask(link(LIVELY, seed, up), counters) for seed in (1, 2) for up in (True, False)]
    assert all(a != b for i, a in enumerate(fates) for b in fates[:i])


def test_conditions_that_change_nothing_change_nothing() -> None:
    """The fast and the general path also give the same impairments."""
    pointless = (Change(1.0, delay=0.045), Change(1000.0, delay=9.0))
    for loss in (0.1, LIVELY.loss):
        steady = DirectionProfile(0.045, 0.06, loss=loss, duplicate=0.1, reorder=0.1)
        changing = DirectionProfile(
            0.045, 0.06, loss=loss, duplicate=0.1, reorder=0.1, changes=pointless
        )
        assert flow(steady, 1000) == flow(changing, 1000)


def test_a_counter_from_anywhere_is_answered() -> None:
    direction = link(LIVELY)
    far = [2**64 - 1, 2**63, 10**12]
    assert ask(direction, far) == ask(link(LIVELY), far[::-1])
    assert ask(direction, [0, 1]) == ask(link(LIVELY), [0, 1])


def test_the_bottleneck_serialises_and_drops_from_the_tail() -> None:
    """972 B + 28 B at 1 Mbit/s take 8 ms; the third finds two in the queue."""
    direction = link(DirectionProfile(0.020, rate=1e6, queue_packets=2))
    at = [direction.send(1, 3, n, 972, now) for n, now in enumerate((0, 0, 0, 9 * MS, 40 * MS))]
    assert at == [(28 * MS,), (36 * MS,), (), (44 * MS,), (68 * MS,)]
    assert direction.counts()["queue"] == 1


def test_what_overtakes_passes_the_bottleneck_by() -> None:
    bad = GilbertElliott(1.0, 0.0, loss_bad=0.0, delay_bad=0.040)
    direction = link(DirectionProfile(0.020, rate=1e3, queue_packets=1, reorder=1.0, loss=bad))
    assert [direction.send(1, 3, n, 972, n) for n in range(3)] == [(0,), (1,), (2,)]


def test_the_time_line_counts_from_the_origin() -> None:
    changes = (Change(1.0, delay=0.050), Change(2.0, jitter=0.0, loss=1.0), Change(3.0, loss=0.0))
    direction = LinkDirection(DirectionProfile(0.020, changes=changes), 1, True, 7 * SECOND)
    for elapsed, delay in ((-1.0, 20), (0.0, 20), (0.999, 20), (1.0, 50), (2.5, None), (3.0, 50)):
        now_ns = 7 * SECOND + round(elapsed * 1e9)
        expected = () if delay is None else (now_ns + delay * MS,)
        assert direction.send(1, 3, 0, SIZE, now_ns) == expected


def test_a_rate_can_come_with_the_time_line() -> None:
    direction = link(DirectionProfile(changes=(Change(1.0, rate=1e6),)))
    assert direction.send(1, 3, 0, 972, 0) == (0,)
    assert direction.send(1, 3, 1, 972, SECOND) == (SECOND + 8 * MS,)


def test_nothing_passes_in_a_blackout() -> None:
    profile = DirectionProfile(0.020, blackouts=(Blackout(1.0, 0.5), Blackout(1.2, 1.0)))
    direction = link(profile)
    sent = {t: direction.send(1, 3, 0, SIZE, t * 100 * MS) for t in (9, 10, 15, 21, 22)}
    assert [t for t, releases in sent.items() if not releases] == [10, 15, 21]
    assert direction.counts()["blackout"] == 3


def test_a_trace_holds_each_row_until_the_next() -> None:
    trace = Trace((1.0, 2.0, 3.0), (0.010, 0.020, 0.030), (0.0, 1.0, 0.0))
    direction = link(DirectionProfile(9.0, loss=1.0, trace=trace))
    sent = [direction.send(1, 3, 0, SIZE, t * SECOND) for t in (0, 1, 2, 3, 100)]
    delays = [
        releases[0] - t * SECOND if releases else None
        for t, releases in zip((0, 1, 2, 3, 100), sent, strict=True)
    ]
    assert delays == [10 * MS, 10 * MS, None, 30 * MS, 30 * MS]


def test_a_trace_without_losses_keeps_loss_and_adds_jitter() -> None:
    fate = flow(DirectionProfile(9.0, 0.005, loss=0.5, trace=Trace((0.0,), (0.030,))), 2000)
    arrived = [copies[0] for copies in fate if copies]
    assert 800 < len(arrived) < 1200
    assert 25 * MS <= min(arrived) < 26 * MS < 34 * MS < max(arrived) <= 35 * MS


def test_a_new_time_line_may_count_from_the_next_packet() -> None:
    after = DirectionProfile(0.02, changes=(Change(5.0, delay=0.2),))
    direction = LinkDirection(DirectionProfile(0.04), 1, True, 0)
    direction.replace_profile(after, restart=True)
    for now, delay in ((7.0, 0.02), (11.9, 0.02), (12.1, 0.2)):
        (release_ns,) = direction.send(1, 3, 0, 172, round(now * 1e9))
        assert release_ns == round(now * 1e9) + round(delay * 1e9)


def test_a_new_profile_keeps_seed_origin_and_counts() -> None:
    changes = (Change(5.0, delay=0.2),)
    after = DirectionProfile(0.02, 0.01, distribution="normal", loss=0.1, changes=changes)
    direction = LinkDirection(DirectionProfile(0.04, 0.01), 1, True, 100)
    always = LinkDirection(after, 1, True, 100)
    for n in range(300):
        direction.send(1, 3, n, 172, n)
    direction.replace_profile(after)
    for n, now_ns in ((299, 400), (300, 500), (900, 5_000_000_200)):
        assert direction.send(1, 3, n, 172, now_ns) == always.send(1, 3, n, 172, now_ns)
    assert direction.counts()["passed"] >= 300
