# SPDX-License-Identifier: Apache-2.0

"""The model of a direction: random draws, queue, order, schedule and statistics."""

import random
from math import erf, isnan, sqrt

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cloudrc.link.draws import BLOCK, Purpose, bad_states, normals, stream_key, uniforms
from cloudrc.link.model import LinkDirection
from cloudrc.link.profile import Radio, Trace
from cloudrc.link.streams import Stream, loss_runs, numbers, sample
from tests.link.profiles import blackout, change, changed, in_bursts, profile_of

MS, SECOND = 1_000_000, 1_000_000_000
PERIOD_NS, SIZE = 10 * MS, 172
COUNT = 20_000
KEY = stream_key(1, True, 1, 3)
LIVELY = profile_of(
    0.045,
    0.025,
    "pareto",
    0.5,
    in_bursts(0.02, 0.2, 0.5, 0.01, 0.03),
    duplicate=0.05,
    reorder=0.05,
)
profiles = st.builds(
    profile_of,
    delay=st.floats(0, 0.5),
    jitter=st.floats(0, 0.5),
    distribution=st.sampled_from(["uniform", "normal", "pareto"]),
    correlation=st.sampled_from([0.0, 0.5, 1.0]),
    loss=st.sampled_from([0.0, 0.3, in_bursts(0.1, 0.3, 0.5, 0.1, 0.1)]),
    duplicate=st.sampled_from([0.0, 0.5]),
    reorder=st.sampled_from([0.0, 0.5]),
    keep_order=st.booleans(),
    rate=st.sampled_from([None, 1e5]),
    queue_packets=st.sampled_from([1, 10]),
    changes=st.sampled_from([(), (change(0.5, 0.01, 0.02, 0.1, 1e6), change(1.0, loss=0.0))]),
    blackouts=st.sampled_from([(), (blackout(0.2, 0.1),)]),
    radio=st.sampled_from([None, None, Radio(phase_ms="random")]),
)


def link(profile, seed=1, uplink=True):
    return LinkDirection(profile, seed, uplink)


def flow(profile, count):
    """Return the delays [ns] of each packet's copies, one packet per 10 ms."""
    direction = link(profile)
    return [
        tuple(at - n * PERIOD_NS for at in direction.send(1, 3, n, SIZE, n * PERIOD_NS))
        for n in range(count)
    ]


def ask(direction, counters):
    return {n: direction.send(1, 3, n, SIZE, n * PERIOD_NS) for n in counters}


def test_the_first_draws_of_a_stream_are_these():
    """A change of the draws changes every published flight; note it in the change log."""
    first = [0.91781617987454, 0.51679997741454, 0.6141663944716]
    assert uniforms(KEY, Purpose.DELAY, 0)[:3] == pytest.approx(first, abs=1e-12)
    with pytest.raises(ValueError, match="read-only"):
        uniforms(KEY, Purpose.DELAY, 0)[0] = 0.5


def test_correlated_draws_follow_their_equations():
    fresh, correlated = (normals(KEY, Purpose.DELAY, 0, c) for c in (0.0, 0.6))
    assert correlated[0] == fresh[0]
    assert correlated[1] == pytest.approx(0.6 * fresh[0] + 0.8 * fresh[1])
    assert normals(KEY, Purpose.DELAY, 1, 0.6)[0] == pytest.approx(
        0.6 * correlated[-1] + 0.8 * normals(KEY, Purpose.DELAY, 1, 0.0)[0]
    )
    state, draw = bad_states(KEY, 0, 0.3, 0.4), uniforms(KEY, Purpose.STATE, 0)
    assert state[0] == (draw[0] < 0.3 / 0.7)
    for n in range(1, BLOCK):
        assert state[n] == ((draw[n] >= 0.4) if state[n - 1] else (draw[n] < 0.3))
    assert not any(bad_states(KEY, 0, 0.0, 0.0))
    assert all(bad_states(KEY, 0, 0.1, 0.0))


def uniform(z):
    return (z + 1) / 2


def normal(z):
    return np.array([0.5 * (1 + erf(one / sqrt(2))) for one in z])


def pareto(z):
    """Exponent 3, cut at its 99.9 % quantile; then mean 0 and standard deviation 1."""
    cut = 1e-3
    mean = 1.5 * (1 - cut ** (2 / 3)) / (1 - cut)
    square = 3 * (1 - cut ** (1 / 3)) / (1 - cut)
    raw = np.maximum(z * sqrt(square - mean**2) + mean, 1.0)
    return (1 - raw**-3.0) / (1 - cut)


@pytest.mark.parametrize("count", [100_000, pytest.param(1_000_000, marks=pytest.mark.full)])
@pytest.mark.parametrize(
    ("shape", "cumulative", "deviation"),
    [("uniform", uniform, 1 / sqrt(3)), ("normal", normal, 1.0), ("pareto", pareto, 1.0)],
)
def test_many_draws_match_their_distribution(shape, cumulative, deviation, count):
    delay, jitter, loss, root = 0.060, 0.005, 0.02, sqrt(count)
    packets = flow(profile_of(delay, jitter, shape, loss=loss), count)
    lost = np.array([not copies for copies in packets])
    assert lost.mean() == pytest.approx(loss, abs=4 * sqrt(loss * (1 - loss)) / root)
    assert np.mean(loss_runs(stream_of(lost))) == pytest.approx(1 / (1 - loss), rel=10 / root)
    drawn = np.sort((np.array([one[0] for one in packets if one]) * 1e-9 - delay) / jitter)
    assert drawn.mean() == pytest.approx(0.0, abs=4.04 / root)
    assert drawn.std() == pytest.approx(deviation, rel=10 / root)
    some = drawn[:: count // 2000]
    share = np.linspace(0, 1, drawn.size)[:: count // 2000]
    # Kolmogorov-Smirnov distance that one in a thousand seeds exceeds by chance.
    assert cumulative(some) == pytest.approx(share, abs=1.97 / root)


def stream_of(lost):
    return Stream(np.arange(len(lost)), np.where(lost, np.nan, 0.1), (~lost).astype(int))


def test_a_table_is_drawn_from_about_its_mean():
    """A quarter of the packets is late by 1.73 jitters; the others are early by 0.58."""
    table = (-1 / sqrt(3),) * 3 + (sqrt(3),)
    for correlation, least, most in ((0.0, -0.03, 0.03), (0.6, 0.3, 1.0)):
        profile = profile_of(0.045, 0.005, "table", correlation, quantiles=table)
        drawn = 1e-9 * np.ravel(flow(profile, COUNT))
        assert set(np.round(drawn * 1e9)) == {round(45e6 + 5e6 * value) for value in set(table)}
        assert drawn.mean() == pytest.approx(0.045, abs=0.0002)
        assert least < np.corrcoef(drawn[:-1], drawn[1:])[0, 1] < most


def test_the_bad_state_loses_or_delays_packets():
    loss = in_bursts(0.1, 0.1, loss_bad=0.5, loss_good=0.0, delay_bad=0.040)
    arrivals = flow(profile_of(0.030, loss=loss), COUNT)
    assert set(arrivals) == {(), (30 * MS,), (70 * MS,)}
    assert arrivals.count(()) / COUNT == pytest.approx(0.25, abs=0.02)
    assert arrivals.count((70 * MS,)) / COUNT == pytest.approx(0.25, abs=0.02)
    for certain in (1.0, in_bursts(1.0, 0.0)):
        assert set(flow(profile_of(duplicate=1.0, loss=certain), 1000)) == {()}


def test_a_reordered_packet_skips_delay_and_queue():
    arrivals = flow(profile_of(0.045, 0.005, reorder=0.1), COUNT)
    assert arrivals.count((0,)) / COUNT == pytest.approx(0.1, abs=0.01)
    assert min(copies[0] for copies in arrivals if copies != (0,)) >= 40 * MS
    bad = in_bursts(1.0, 0.0, loss_bad=0.0, delay_bad=0.040)
    slow = profile_of(0.030, rate=1e3, queue_packets=1, reorder=1.0, loss=bad)
    assert set(flow(slow, 100)) == {(0,)}


def test_damage_flips_one_bit_and_changes_no_other_draw():
    profile, data = changed(LIVELY, corrupt=0.2), bytes(SIZE)
    one, other = link(profile, 7), link(profile, 7)
    damaged = [one.corrupted(1, 3, n, data) for n in range(COUNT)]
    places = [np.flatnonzero(np.unpackbits(np.frombuffer(d, np.uint8))) for d in damaged]
    hit = [int(place[0]) for place in places if place.size]
    assert max(place.size for place in places) == 1
    assert len(hit) / COUNT == pytest.approx(0.2, abs=5 * sqrt(0.2 * 0.8 / COUNT))
    shares, _ = np.histogram(hit, bins=8, range=(0, 8 * SIZE))
    assert shares.min() > 0.8 * len(hit) / 8
    assert damaged[:600] == [other.corrupted(1, 3, n, data) for n in reversed(range(600))][::-1]
    assert {one.corrupted(1, 3, n, b"") for n in range(50)} == {b""}
    assert flow(profile, 600) == flow(LIVELY, 600)


@given(profile=profiles, seed=st.integers(0, 2**63 - 1))
@settings(max_examples=60, deadline=None)
def test_nothing_arrives_before_the_shortest_delay(profile, seed):
    direction = link(profile, seed)
    shortest_ns = direction.shortest_ns
    assert shortest_ns >= 0
    packets = [direction.send(1, 3, n, SIZE, n * 5 * MS) for n in range(400)]
    for n, releases in enumerate(packets):
        assert len(releases) <= 2
        assert all(type(r) is int and r >= n * 5 * MS + shortest_ns for r in releases)
    if profile.keep_order:
        arrivals = [r for releases in packets for r in releases]
        assert arrivals == sorted(arrivals)


@pytest.mark.promise("link-follows-the-seed")
@pytest.mark.parametrize(
    "profile", [LIVELY, profile_of(0.01, 0.01, changes=(change(10.0, 0.02, loss=0.2),))]
)
def test_draws_depend_on_seed_kind_epoch_and_counter_alone(profile):
    counters = [*range(3000), *range(100_000, 101_000), 10**12, 2**63, 2**64 - 1]
    among, alone = link(profile), ask(link(profile), counters)
    for n in random.Random(1).sample(counters, len(counters)):
        for kind, epoch in ((1, 0), (1, 1), (3, 2)):
            among.send(epoch, kind, n, 40, n * PERIOD_NS)
        assert among.send(1, 3, n, SIZE, n * PERIOD_NS) == alone[n]
    others = [ask(link(profile, seed, up), counters) for seed, up in ((2, True), (1, False))]
    assert alone != others[0] != others[1] != alone


def test_the_bottleneck_serialises_and_drops_from_the_tail():
    """972 B + 28 B at 1 Mbit/s take 8 ms; the third finds two in the queue."""
    direction = link(profile_of(0.020, changes=(change(1.0, rate=1e6),), queue_packets=2))
    times = (0, 1000, 1000, 1000, 1009, 1040)
    arrivals = [direction.send(1, 3, n, 972, now * MS) for n, now in enumerate(times)]
    at = (20,), (1028,), (1036,), (), (1044,), (1068,)
    assert arrivals == [tuple(one * MS for one in copies) for copies in at]


def test_the_schedule_counts_from_the_origin():
    changes = (change(1.0, delay=0.050), change(2.0, jitter=0.0, loss=1.0), change(3.0, loss=0.0))
    profile = profile_of(0.020, changes=changes, blackouts=(blackout(4.0, 0.5), blackout(4.2, 1.0)))
    direction = LinkDirection(profile, 1, True, 7 * SECOND)
    expected = {-1.0: 20, 0.0: 20, 0.999: 20, 1.0: 50, 2.5: None, 3.0: 50, 4.0: None, 5.1: None}
    for elapsed, delay in (expected | {5.2: 50}).items():
        now_ns = 7 * SECOND + round(elapsed * 1e9)
        at = () if delay is None else (now_ns + delay * MS,)
        assert direction.send(1, 3, 0, SIZE, now_ns) == at
    assert direction.blackouts == 2


@pytest.mark.parametrize("loop", [False, True])
def test_a_trace_holds_each_row_until_the_next(loop):
    """If the trace loops, its last row lasts as long as the mean row: the period is 4 s."""
    trace = Trace((1.0, 2.0, 3.0), (0.010, 0.020, 0.030), (0.0, 1.0, 0.0))
    direction = link(profile_of(9.0, loss=1.0, rows=trace, loop=loop))
    late = ((3 * 3600 + t, delay) for t, delay in ((0, 10), (2, None), (3, 30)) if loop)
    for t, delay in ((0, 10), (1, 10), (2, None), (3, 30), (4, 10 if loop else 30), *late):
        at = () if delay is None else (t * SECOND + delay * MS,)
        assert direction.send(1, 3, 0, SIZE, t * SECOND) == at


def test_a_new_profile_keeps_seed_and_origin():
    changes = (change(5.0, delay=0.2),)
    after = profile_of(0.02, 0.01, distribution="normal", loss=0.1, changes=changes)
    direction, always = LinkDirection(LIVELY, 1, True, 100), LinkDirection(after, 1, True, 100)
    for n in range(300):
        direction.send(1, 3, n, 172, n)
    direction.replace_profile(after)
    for n, now_ns in ((299, 400), (300, 500), (900, 5_000_000_200)):
        assert direction.send(1, 3, n, 172, now_ns) == always.send(1, 3, n, 172, now_ns)
    direction.replace_profile(profile_of(0.02, changes=changes), restart=True)
    for now, delay in ((7.0, 0.02), (11.9, 0.02), (12.1, 0.2)):
        (arrival_ns,) = direction.send(1, 3, 0, 172, round(now * 1e9))
        assert arrival_ns == round(now * 1e9) + round(delay * 1e9)


def test_statistics_of_losses_copies_and_of_nothing():
    def measured(profile, count):
        return numbers(sample(link(profile), 3, range(0, count * PERIOD_NS, PERIOD_NS), 191))

    stream = stream_of(np.array([0, 1, 1, 0, 1, 0, 0, 1, 1, 1], dtype=bool))
    assert (loss_runs(stream), numbers(stream).loss) == ((2, 1, 3), pytest.approx(0.6))
    found = measured(profile_of(0.070, 0.040, duplicate=0.1, loss=0.5), COUNT)
    assert (found.least, found.most) == pytest.approx((0.03, 0.11), abs=0.0001)
    assert found.duplicated == pytest.approx(0.05, rel=0.1)
    nothing = measured(profile_of(loss=1.0), 10)
    assert (nothing.loss, nothing.runs) == (1.0, (10,))
    assert all(isnan(value) for value in (nothing.mean, nothing.p99, nothing.correlation))
    constant = measured(profile_of(0.2703), 1000)
    assert (constant.deviation, isnan(constant.correlation)) == (0.0, True)


def test_the_share_of_overtaken_packets_is_that_of_all_that_arrived():
    """Of four packets one is lost and the first is overtaken (RFC 4737)."""
    stream = Stream(np.array([0.0, 1.0, 2.0, 3.0]), np.array([1.5, 0.1, np.nan, 0.1]), np.ones(4))
    assert numbers(stream).overtaken == pytest.approx(1 / 3)
    one = Stream(np.zeros(1), np.ones(1), np.ones(1))
    assert numbers(one).overtaken == 0.0


@pytest.mark.parametrize(
    ("profile", "shortest"),
    [
        (profile_of(0.1, 0.01), 0.09),
        (profile_of(0.1, 0.01, "normal"), 0.01),
        (profile_of(0.1, 0.01, "pareto"), 0.093),
        (profile_of(0.1, 0.01, "table", quantiles=(-2.0, 0.0, 2.0)), 0.08),
        (profile_of(0.1, changes=(change(1.0, 0.05, 0.01),)), 0.04),
        (profile_of(0.1, 0.01, reorder=0.1), 0.0),
        (profile_of(0.01, 0.02), 0.0),
        (profile_of(0.1, 0.01, radio=Radio()), 0.093),
    ],
)
def test_the_shortest_delay_is_that_of_the_largest_jitter(profile, shortest):
    assert link(profile).shortest_ns * 1e-9 == pytest.approx(shortest, abs=3e-9)
    assert link(changed(profile, corrupt=0.5)).corrupts > link(profile).corrupts
