# SPDX-License-Identifier: Apache-2.0

"""A radio that schedules, against closed forms and by hand; and who else knows of it."""

import re
from dataclasses import replace

import numpy as np
import pytest

import cloudrc.link
from cloudrc.base.errors import BadInputError
from cloudrc.config.load import load_experiment
from cloudrc.config.resolved import dump
from cloudrc.doors.cli.eval_values import check_round_trips
from cloudrc.gym.asked import expected
from cloudrc.gym.lane import DATAGRAMS, Wire
from cloudrc.link.carry.tcp.medium import Medium
from cloudrc.link.cell import Cell, CellQueue
from cloudrc.link.library import LinkProfile
from cloudrc.link.model import LinkDirection
from cloudrc.link.profile import DirectionProfile, Radio
from cloudrc.link.radio import RadioParts, repetitions, slots_of
from cloudrc.studies.eval.setup import Episode, EvalSetup, link_at
from tests.link.profiles import changed, profile_of

MS, US = 1_000_000, 1_000
SURE = Radio(error=0.0)
BEHIND = 3 * MS
"""Delay behind the radio, as in `5g-sa` [ns]."""
COUNT = 40_000


def radio(**keys):
    return replace(SURE, **keys)


def delays(way, sent_ns, epoch=0):
    """Return the delays of packets in the radio and behind it [ms]."""
    return np.array([way.send(epoch, 128, n, 100, t)[0] - t for n, t in enumerate(sent_ns)]) / MS


def link(asked, uplink=True, seed=1, **keys):
    profile = DirectionProfile(delay_ms=BEHIND / MS, radio=asked, **keys)
    return LinkDirection(profile, seed, uplink)


@pytest.mark.parametrize(
    ("asked", "uplink", "least", "mean", "most"),
    [
        (radio(), True, 6.0, 11.0, 16.0),
        (radio(request_ms=40), True, 6.0, 26.0, 46.0),
        (radio(grant_ms=2.1), True, 8.5, 13.5, 18.5),
        (radio(request_ms=0), True, 3.5, 4.75, 6.0),
        (radio(), False, 3.5, 4.05, 5.0),
    ],
)
def test_delays_at_random_phases_have_their_closed_form(asked, uplink, least, mean, most):
    span = slots_of(asked, uplink).span
    assert [each / MS + 3 for each in span] == pytest.approx([least, mean, most], abs=1e-9)
    sent_ns = np.random.default_rng(1).integers(0, 10**12, COUNT).tolist()
    found = delays(link(asked, uplink), sent_ns)
    assert found.mean() == pytest.approx(mean, abs=3 * found.std() / COUNT**0.5)
    assert least <= found.min() < least + 0.01
    assert most - 0.01 < found.max() < most


def test_a_packet_that_is_ready_when_a_slot_begins_takes_it():
    """U begins at 2.0 ms; the grant is ready at 4.5 ms, in which the next U begins."""
    split = slots_of(SURE, uplink=True).split
    assert split(2 * MS, 0, 0) == RadioParts(0, 3 * MS, 0)
    assert split(2 * MS + 1, 0, 0) == RadioParts(10 * MS - 1, 3 * MS, 0)
    assert split(0, 2 * MS, 3) == RadioParts(0, 3 * MS, 15 * MS)
    assert slots_of(radio(grant_ms=2.000001), uplink=True).split(2 * MS, 0, 0).grant_ns == 5.5 * MS
    free = slots_of(radio(request_ms=0), uplink=True).split
    assert [sum(free(at, 0, 0)) for at in (2 * MS, 2 * MS + 1)] == [500 * US, 3 * MS - 1]
    down = slots_of(SURE, uplink=False).split
    assert [sum(down(at, 0, 0)) for at in (0, 1, MS, MS + 1)] == [
        500 * US, MS - 1, 500 * US, 2 * MS - 1
    ]  # fmt: skip


@pytest.mark.parametrize(("phase", "mean"), [(0.0, 8.0), (2.1, 15.9), (6.0, 12.0)])
def test_telemetry_at_100_hz_has_the_delay_of_its_phase(phase, mean):
    times = range(0, COUNT * 10 * MS, 10 * MS)
    assert {*delays(link(radio(phase_ms=phase)), times[:1000])} == {mean}
    found = delays(link(radio(phase_ms=phase, error=0.1)), times)
    assert found.mean() == pytest.approx(mean + 0.5556, abs=3 * found.std() / COUNT**0.5)


def test_clocks_that_drift_make_a_delay_that_drifts():
    way = link(radio(drift_ppm=50, error=0.1))
    found = delays(way, range(0, 20_000 * 10 * MS, 10 * MS))  # 200 s: one pass through all phases
    assert found.mean() == pytest.approx(11.56, abs=0.1)
    assert np.corrcoef(found[:-1], found[1:])[0, 1] == pytest.approx(0.73, abs=0.02)
    (at_ns,) = link(radio(drift_ppm=50)).send(0, 128, 0, 100, 40_000 * MS)
    assert at_ns - 40_000 * MS == 3 * MS + 3 * MS  # 2 ms later on the clock of the radio: U begins


@pytest.mark.parametrize(("rate", "least", "most"), [(100, 6.0, 15.9), (125, 10.0, 11.9)])
def test_125_hz_do_not_lock_to_the_requests(rate, least, most):
    period_ns = round(1e9 / rate)
    means = [
        delays(link(radio(phase_ms=phase)), range(0, 40 * period_ns, period_ns)).mean()
        for phase in np.arange(0, 10, 0.1).tolist()
    ]
    assert (min(means), max(means)) == pytest.approx((least, most), abs=0.001)


def test_repetitions_are_geometric_and_leave_other_draws_alone():
    times = repetitions(0.1, 1, True, 0, 128, "", 0, 0)
    for block in range(1, 400):
        times = times + repetitions(0.1, 1, True, 0, 128, "", block, 0)
    for n in range(3):
        share, asked = np.mean(np.array(times) >= n), 0.1**n
        assert share == pytest.approx(asked, abs=3 * (asked / len(times)) ** 0.5)
    plain = profile_of(0.02, 0.01, loss=0.1, duplicate=0.2)
    way = LinkDirection(changed(plain, radio=Radio()), 1, True)
    bare, differ = LinkDirection(plain, 1, True), 0
    for n in range(2000):
        now_ns = n * 7 * MS
        parts = [sum(way.radio_parts(0, 128, n, now_ns, copy)) for copy in (0, 1)]
        arrivals = way.send(0, 128, n, 100, now_ns)
        assert [at - part for at, part in zip(arrivals, parts, strict=False)] == [
            *bare.send(0, 128, n, 100, now_ns)
        ]
        differ += parts[0] != parts[1]
    assert differ / 2000 == pytest.approx(0.18, abs=0.03)


def test_a_phase_at_random_is_that_of_seed_stream_direction_and_episode():
    profile = DirectionProfile(radio=radio(phase_ms="random"))

    def phase(seed=1, uplink=True, epoch=0, kind=128, stream="", number=0):
        way = LinkDirection(profile, seed, uplink, stream=stream)
        return way.radio_parts(epoch, kind, number, 0).request_ns

    assert phase() == phase(kind=3) == phase(number=9)
    assert len({phase(), phase(seed=2), phase(epoch=1), phase(stream="a")}) == 4
    drawn = np.array([phase(epoch=n) for n in range(2000)]) / MS
    assert drawn.mean() == pytest.approx(5.0, abs=3 * 10 / 12**0.5 / 2000**0.5)
    assert drawn.min() >= 0
    assert drawn.max() < 10
    down = [
        LinkDirection(profile, 1, False).radio_parts(n, 3, 0, 0).grant_ns / MS for n in range(2000)
    ]
    assert np.mean(down) == pytest.approx(1.05, abs=0.04)


def test_the_radio_follows_the_bottleneck_and_order_is_kept_last():
    """125 bytes at 100 kbit/s take 10 ms: the packet of 1 ms enters the radio at 11 ms."""
    way = link(SURE, rate_kbit=100.0)
    assert way.send(0, 128, 0, 97, MS) == (12 * MS + 3 * MS + BEHIND,)
    assert link(SURE, reorder=1.0).send(0, 128, 0, 97, MS) == (MS,)
    again = radio(error=0.9, repeat_ms=50)
    arrivals = [link(again).send(0, 128, n, 97, n * 10 * MS)[0] for n in range(100)]
    kept = link(again, keep_order=True)
    in_order = [kept.send(0, 128, n, 97, n * 10 * MS)[0] for n in range(100)]
    assert arrivals != sorted(arrivals)
    assert in_order == np.maximum.accumulate(arrivals).tolist()


def test_the_time_of_the_radio_is_that_of_the_schedule():
    way = LinkDirection(DirectionProfile(radio=SURE), 1, True, 7 * MS)
    assert way.send(0, 128, 0, 100, 9 * MS) == (12 * MS,)
    assert way.only is None


def test_a_cell_adds_the_delay_of_the_time_of_sending_behind_it():
    links = [link(SURE), link(SURE, uplink=False)]
    cell, left = Cell(1e6), []
    queue = CellQueue(0, [cell], [False, False], links, lambda way, at, data: left.append(at))
    queue.send(links[0], (128, 0, 0), 97, b"", 2 * MS)
    queue.send(links[0], (128, 0, 1), 97, b"", 2 * MS + 1)
    for at_ns, _, leave in cell.advance(100 * MS):
        leave(at_ns)
    assert left == [((3 + 3 + 3) * MS,), ((4 + 10 + 3 + 3) * MS - 1,)]


def test_a_stream_of_segments_crosses_the_radio():
    medium = Medium(DirectionProfile(delay_ms=3, radio=SURE), 1, True, 0)
    assert medium.cross(1, 0, 128, 100, 2 * MS) == 8 * MS
    assert medium.delay_ns(0) == 11 * MS


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        ({"request_ms": 9}, "uplink.radio: request_ms: 9 ms is no multiple of the 2.5 ms of the"),
        ({"tdd": "DDXSU"}, "tdd: 'DDXSU': give letters D, S and U"),
        ({"tdd": "DDD"}, "at least one D and one U"),
        ({"error": 1}, "uplink.radio.error: 1: must be a number >= 0 and <= 0.99"),
        ({"slot_ms": 0}, "uplink.radio.slot_ms"),
        ({"phase_ms": "any"}, "uplink.radio.phase_ms: 'any': must be"),
        ({"grant": 2}, "uplink.radio.grant"),
    ],
)
def test_a_radio_that_cannot_be_is_refused_by_its_key(keys, says):
    with pytest.raises(BadInputError, match=re.escape(says)):
        cloudrc.link.open({"uplink": {"radio": keys}}, 1)
    values = ",".join(f"{key}: {value}" for key, value in keys.items())
    with pytest.raises(BadInputError, match="radio"):
        load_experiment("paper", [f"link.uplink.radio={{{values}}}"])


def test_an_experiment_without_a_radio_does_not_name_it():
    assert "radio" not in dump(load_experiment("paper", ["link.profile=5g"]))
    again = load_experiment("paper", ["link.profile=5g-sa", "link.uplink.radio.request_ms=0"])
    assert again.uplink.radio.request_ms == 0
    assert again.downlink.radio.tdd == "DDDSU"
    assert "radio" not in repr(DirectionProfile(radio=None))


def test_what_a_link_asks_for_has_the_mean_of_all_phases():
    at_random = Radio(phase_ms="random")
    link_of = LinkProfile(*[DirectionProfile(delay_ms=3, radio=at_random)] * 2)
    for uplink, mean in ((True, 11.556), (False, 4.606)):
        found, loss = expected(Wire(link_of, uplink, 100, DATAGRAMS, 1200), 0.01)
        assert (found * 1e3, loss) == (pytest.approx(mean, abs=0.3), 0.0)
    up, _ = cloudrc.link.open("5g-sa-configured", 1)
    assert up.expected().mean * 1e3 == pytest.approx(4.75 + 0.556, abs=0.1)


def test_a_round_trip_that_is_asked_for_has_the_radio_in_it():
    found = link_at("5g-sa", 50.0)
    assert found.uplink.delay_ms == found.downlink.delay_ms
    ways = found.uplink.delay_ms + found.downlink.delay_ms
    assert ways + (8.0 + 0.5556) + (1.05 + 0.5556) == pytest.approx(50.0, abs=1e-3)
    with pytest.raises(BadInputError, match="alone takes 10"):
        check_round_trips("5g-sa", (50.0, 10.0))


def test_a_key_of_the_radio_makes_other_rows_of_an_evaluation():
    episode, bare = Episode(None, "newest", 1), {"uplink": {"delay_ms": 3}}
    keys = {
        episode.key(replace(EvalSetup("E", "http://x"), link=link).identity())
        for link in (bare, {"uplink": {"delay_ms": 3, "radio": {}}}, "5g-sa", "5g-sa-configured")
    }
    assert len(keys) == 4
