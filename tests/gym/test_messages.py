# SPDX-License-Identifier: Apache-2.0

"""Messages of any size: the packets of which they are made, and what of them arrives."""

import random
from math import sqrt
from statistics import fmean

import numpy as np
import pytest
from gymnasium.wrappers import TimeLimit

import cloudrc.link
from cloudrc.gym import Networked
from cloudrc.gym.asked import AskedOfWire, Met, expected
from cloudrc.gym.doubts import LinkWarning
from cloudrc.gym.lane import Lane, Wire
from cloudrc.link.carry.tcp.stream import MessageStream, Segment
from cloudrc.link.library import Cut, read_profile
from tests.gym.envs import Counter, both_ways, told

IMAGE = 921_600
"""Size of a camera's image of 640 x 480 pixels [bytes]: 768 packets."""
MS = 1_000_000


def wire(link, size, delivery="datagrams", packet_bytes=1200):
    return Wire(read_profile(link), True, size, delivery, packet_bytes)


def delays(link, size, delivery, count, period_ms, seed=1):
    """Send messages, one per period; return the delay of each [ms], NaN if it does not arrive."""
    lane, found = Lane(wire(link, size, delivery), seed, ""), np.full(count, np.nan)
    for number in range(count):
        lane.send(number, round(number * period_ms * MS), number)
    lane.run(10**15)
    while lane.queue.next_ns < 1 << 63:
        arrival_ns, _, number = lane.queue.pop()
        found[number] = arrival_ns / MS - number * period_ms
    return found, lane.summary((0.0, 0.0))


def is_within(values, mean, errors=3.0):
    """Return whether the mean of values is the expected one, within standard errors."""
    return abs(fmean(values) - mean) < errors * np.std(values) / sqrt(len(values))


@pytest.mark.parametrize("usual", [100, 5_000, IMAGE])
def test_no_two_pieces_of_an_episode_share_their_random_numbers(usual):
    draw, cut = random.Random(usual), Cut().for_size(usual)
    stream = MessageStream(None, (None, None), 1, cut, None)
    first, again = set(), set()
    sizes = [round(10 ** draw.uniform(2, 6)) for _ in range(500)]
    for number, size in enumerate(sizes):
        for kind, counter, length in cut.pieces(number, size):
            first.add((kind, counter))
            again.add(stream._repairs(Segment(None, length, kind, counter, attempt=2)))
        assert sum(piece.size for piece in cut.pieces(number, size)) == size
    assert len(first) == len(again) == sum(map(cut.count, sizes))
    assert not first & again


def test_a_message_of_one_packet_has_the_fate_of_the_packet():
    first, second = (cloudrc.link.open("lossy", 3)[0] for _ in range(2))
    for number in range(500):
        arrivals = first.send(1, number, 1200, number * 10 * MS)
        whole = second.send_message(1, number, 1200, number * 10 * MS)
        assert whole == ((min(arrivals),) if arrivals else ())


def test_the_library_and_the_gym_cut_messages_alike():
    link = both_ways(20, 20, jitter_ms=5, loss=0.02)
    up, _ = cloudrc.link.open(link, 1)
    sent = [up.send_message(0, number, 20_000, number * 50 * MS) for number in range(200)]
    found, _ = delays(link, 20_000, "datagrams", 200, 50)
    assert [(round((n * 50 + d) * MS),) if d == d else () for n, d in enumerate(found)] == sent


def test_each_packet_of_a_message_of_datagrams_may_be_lost():
    link = both_ways(30, 30, loss=0.01)
    found, summary = delays(link, 20_000, "datagrams", 4_000, 50)
    assert is_within(~np.isnan(found), 0.99**17)
    assert expected(wire(link, 20_000), 0.05)[1] == pytest.approx(1 - 0.99**17)
    assert expected(wire(link, IMAGE), 0.05)[1] == pytest.approx(1 - 0.000444, abs=1e-6)
    assert (summary["sent"], summary["packets_sent"]) == (4_000, 68_000)
    assert summary["packets_lost"] == pytest.approx(680, abs=3 * sqrt(680))
    damaged = both_ways(30, 30, corrupt=0.01)
    assert expected(wire(damaged, 20_000), 0.05)[1] == pytest.approx(1 - 0.99**17)


def test_bursts_run_through_a_message():
    """Two successive packets of a burst are rarely apart, so more messages stay whole."""
    burst = {"bad_start": 0.01, "bad_end": 0.25}
    link = both_ways(30, 30, loss=burst)
    found, _ = delays(link, 12_000, "datagrams", 3_000, 50)
    good = 0.25 / 0.26 * 0.99**9  # it begins in the good state, and stays there
    assert is_within(~np.isnan(found), good, errors=4.0)
    assert expected(wire(link, 12_000), 0.05)[1] == pytest.approx(1 - good)


def test_the_last_packet_waits_for_those_before_it_at_a_bottleneck():
    link = both_ways(30, 30, rate_kbit=10_000)
    found, _ = delays(link, 24_000, "datagrams", 20, 50)
    late = 20 * (1200 + 28) * 8 / 10_000 + 30
    assert found.tolist() == pytest.approx([late] * 20)
    assert delays(link, 24_000, "stream", 20, 50)[0].tolist() == pytest.approx([late] * 20)


def test_a_queue_with_too_few_places_loses_datagrams_and_delays_a_stream():
    link = both_ways(30, 30, rate_kbit=10_000, queue_packets=10)
    found, _ = delays(link, 24_000, "datagrams", 20, 50)
    assert np.isnan(found).all()
    found, _ = delays(link, 24_000, "stream", 20, 50)
    assert found.tolist() == pytest.approx([20 * 1228 * 8 / 10_000 + 30] * 20)


@pytest.mark.parametrize(
    ("loss", "period_ms", "mean"),
    [
        (0.02, 3_000, 30 + 0.02 * 260 / (1 - 0.04)),  # 35.4: nothing shows a loss in time
        (0.1, 3_000, 30 + 0.1 * 260 / (1 - 0.2)),  # 62.5
        (0.01, 50, 30 + 0.01 * (110 + 60 + 10)),  # 31.8: later messages show it and wait behind it
    ],
)
def test_a_stream_repairs_losses(loss, period_ms, mean):
    found, summary = delays(both_ways(30, 30, loss=loss), 100, "stream", 10_000, period_ms, 2)
    assert not np.isnan(found).any()
    if period_ms == 50:  # successive delays hang together: means of 50 do not
        found = found.reshape(-1, 50).mean(axis=1)
    assert is_within(found, mean)
    assert summary["packets_sent"] == 10_000 + summary["packets_lost"]


def test_all_images_arrive_over_a_stream_but_nearly_all_a_round_trip_late():
    """Of 768 packets 7.7 are lost; the last one shows the losses, unless it is lost, too."""
    found, _ = delays(both_ways(30, 30, loss=0.01), IMAGE, "stream", 80, 400)
    assert not np.isnan(found).any()
    assert np.median(found) == pytest.approx(30 + 60)
    assert is_within(np.isclose(found, 90.0), 0.99 * (1 - 0.01**2) ** 767)
    asked, _ = delays(both_ways(30, 30, loss=0.01), IMAGE, "datagrams", 80, 400)
    assert np.isfinite(asked).mean() < 0.02


@pytest.mark.parametrize("keys", [{}, {"rate_kbit": 500, "queue_packets": 5}])
def test_a_stream_is_as_datagrams_where_nothing_is_lost_and_nothing_overtakes(keys):
    link = both_ways(30, 40, jitter_ms=4, distribution="uniform", **keys)
    first, second = (
        told(Networked(Counter(limit=300), link, 2, delivery=one), 300)
        for one in ("datagrams", "stream")
    )
    for each in (first, second):
        for way in ("uplink", "downlink"):
            del each[-1]["episode"][way]["delay_asked"]  # of other random numbers
            del each[-1]["episode"][way]["delay_measured"]  # of those that have arrived
    assert str(first) == str(second)


def test_large_observations_are_late_or_lost_as_they_are_delivered():
    link, size = both_ways(30, 30, loss=0.05), {"observation_bytes": 24_000}
    with pytest.warns(LinkWarning, match=r"35\.85%"):
        lost = told(Networked(Counter(), link, 1, **size), 500)[-1]
    stream = told(Networked(Counter(), link, 1, delivery="stream", **size), 500)[-1]
    assert lost["lost_uplink"] == pytest.approx(500 * (1 - 0.95**20), abs=33)
    assert stream["lost_uplink"] == stream["lost_downlink"] == 0


@pytest.mark.parametrize(
    ("link", "options", "text"),
    [
        ({"loss": 0.01}, {}, r"768 packets.* 0\.04% .*--delivery stream"),
        ({"rate_kbit": 1e6, "queue_packets": 500}, {}, r"0\.00%.* 500 places"),
        ({"rate_kbit": 10_000}, {"delivery": "stream"}, r"754,483 kbit/s.* 10,000 kbit/s"),
    ],
)
def test_messages_that_a_link_cannot_carry_are_told_in_one_line(link, options, text):
    with pytest.warns(LinkWarning, match=text) as found:
        Networked(Counter(), {"uplink": link}, observation_bytes=IMAGE, **options)
    assert len(found) == 1


@pytest.fixture
def megabit(tmp_path):
    """The path of a capacity trace: 1,500 bytes every 12 ms."""
    (tmp_path / "b.up").write_text("".join(f"{12 * n}\n" for n in range(1, 51)))
    return str(tmp_path / "b.up")


def test_a_capacity_trace_is_a_bottleneck_for_messages_too(megabit):
    link = {"uplink": {"rate_trace": megabit, "queue_packets": 5}}
    assert wire(link, 12_000).occupies == pytest.approx((12_000 + 10 * 28) * 8 / 1e6)
    assert expected(wire(link, 12_000), 0.05)[1] == 1.0  # ten packets, five places
    found, summary = delays(link, 4_000, "stream", 50, 50)
    assert not np.isnan(found).any()
    assert summary["packets_lost"] == 0, "the sender waits for room"


@pytest.mark.filterwarnings("ignore:.*arrive whole")
def test_a_rate_that_is_exceeded_is_told_and_no_delay_guessed(megabit):
    env = TimeLimit(Counter(), 200)
    for link in ({"rate_kbit": 500}, {"rate_trace": megabit}):
        with pytest.warns(LinkWarning, match="its queue fills") as found:
            Networked(env, {"uplink": link}, observation_bytes=40_000, delivery="stream")
        assert len(found) == 1


def test_the_delay_of_a_queue_that_fills_is_asked_of_the_messages_of_the_episode():
    link = {"rate_kbit": 500, "queue_packets": 10_000}
    found, _ = delays({"uplink": link}, 40_000, "stream", 50, 20)
    asked = AskedOfWire(wire({"uplink": link}, 40_000, "stream"), 0.02).of(Met(0, 50 * 20 * MS))
    assert asked == pytest.approx((found.mean() / 1e3, 0.0))
    assert found[-1] > 40 * found[0]


def test_a_robot_that_asks_rarely_is_not_told_about_the_rate():
    slow = {"uplink": {"rate_kbit": 1_000}}
    Networked(Counter(), slow, observation_bytes=12_000, chunk=8, executor="broker")
