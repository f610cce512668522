# SPDX-License-Identifier: Apache-2.0

"""Where a schedule begins: numbers by hand, who shares a start, and capacity traces."""

from math import sqrt

import pytest

from cloudrc import link
from cloudrc.base.errors import BadInputError
from cloudrc.link.model import LinkDirection
from cloudrc.link.opportunities import Opportunities
from cloudrc.link.profile import LinkSchedule
from cloudrc.link.traces import read_opportunities
from tests.link.profiles import profile_of

BLACKOUT = {"blackouts": [{"start_s": 1, "duration_s": 0.5}], "repeat_s": 4}
MS = 1_000_000


def starts(profile, seeds, stream=""):
    both = link.read_profile(profile)
    return [both.start_ns(seed, 0, stream) / 1e9 for seed in seeds]


@pytest.mark.parametrize(("length", "share"), [(10.0, 20.3 / 30), (4.0, 8.35 / 30)])
def test_an_episode_over_handover_meets_a_blackout_as_often_as_by_hand(length, share):
    count, met = 2000, 0
    both = link.read_profile("handover")
    mapping = {"uplink": both.uplink, "downlink": both.downlink, "start_s": "random"}
    for start in starts(link.LinkProfile(**mapping), range(count)):
        ends = (10.0, 10.05), (20.0, 20.3), (40.0, 40.05)
        met += any(begin < start + length and start < end for begin, end in ends)
    assert abs(met / count - share) < 3 * sqrt(share * (1 - share) / count)


def test_both_directions_begin_at_one_place_and_go_round():
    up, down = link.open({"uplink": BLACKOUT, "downlink": BLACKOUT, "start_s": "random"}, 5)
    times = range(0, 10_000 * MS, MS)
    lost = [[not way.send(3, n, 100, now) for n, now in enumerate(times)] for way in (up, down)]
    assert lost[0] == lost[1]
    assert sum(lost[0]) == pytest.approx(1250, abs=251), "10 s of a line of 4 s"


def test_the_longer_period_counts_and_seed_episode_and_stream_decide(tmp_path):
    (tmp_path / "trace.csv").write_text("time_s,delay_ms\n0,10\n50,20\n")
    path = str(tmp_path / "trace.csv")
    profile = {"uplink": BLACKOUT, "downlink": {"trace": path}, "start_s": "random"}
    both = link.read_profile(profile)
    found = starts(both, range(200))
    assert 90 < max(found) < 100, "the period of the trace"
    assert found == starts(both, range(200))
    assert len({*found, *starts(both, [0], "robot"), both.start_ns(0, 1) / 1e9}) == 202


def test_a_number_shifts_the_line_and_without_loop_it_ends():
    line = {"changes": [{"at_s": 3, "delay_ms": 50}], "repeat_s": 4, "delay_ms": 10}

    def delays(**more):
        up, _ = link.open({"uplink": {**line, **more}, "start_s": 2}, 1)
        return [up.send(0, n, 100, n * 1000 * MS)[0] // MS - n * 1000 for n in range(6)]

    assert delays() == [10, 50, 50, 50, 50, 50]
    assert delays(loop=True) == [10, 50, 10, 10, 10, 50]


def test_a_new_profile_begins_its_own_line():
    before = profile_of(0.01)
    after = profile_of(0.01, changes=link.read_profile("handover").uplink.changes)
    way = LinkDirection(before, 1, True)
    way.send(1, 1, 0, 100, 0)
    way.replace_profile(after, restart=True, start_ns=19_500 * MS)
    way.send(1, 1, 1, 100, 7000 * MS)
    assert way._origin_ns == (7000 - 19_500) * MS


@pytest.mark.parametrize(
    ("uplink", "start", "text"),
    [
        ({"loop": True}, None, "uplink: loop: the schedule has no period; give repeat_s"),
        ({"delay_ms": 1}, "random", "start_s: random: the schedule has no period"),
        ({**BLACKOUT, "repeat_s": 1.4}, None, "repeat_s: 1.4 s ends before the last entry"),
        ({"rate_trace": "a.up", "rate_kbit": 5}, None, "rate_kbit and rate_trace are both a rate"),
        ({"delay_ms": 1}, "now", "start_s: 'now': must be a number >= 0 or one of random or null"),
    ],
)
def test_what_cannot_be_is_refused(uplink, start, text):
    with pytest.raises(BadInputError, match="profile: ") as caught:
        link.read_profile({"uplink": uplink, "start_s": start})
    assert text in str(caught.value)


def test_a_period_within_its_trace_is_refused(tmp_path):
    (tmp_path / "trace.csv").write_text("time_s,delay_ms\n0,10\n50,20\n")
    with pytest.raises(BadInputError, match="repeat_s: 40 s ends before the last entry, at 50 s"):
        link.read_profile({"uplink": {"trace": str(tmp_path / "trace.csv"), "repeat_s": 40}})


@pytest.fixture
def rates(tmp_path):
    """Open an uplink with opportunities at these times [ms]."""

    def write(*times, **more):
        path = tmp_path / "a.up"
        path.write_text("".join(f"{time}\n" for time in times))
        return link.open({"uplink": {"rate_trace": str(path), **more}}, 1)[0]

    return write


def test_an_opportunity_every_12_ms_is_1_mbit_per_second(rates):
    up = rates(12)
    arrivals = [up.send(0, n, 1500 - 28, 0)[0] for n in range(100)]
    assert arrivals == [12 * (n + 1) * MS for n in range(100)]
    assert 100 * 1500 * 8 / (arrivals[-1] / 1e9) == pytest.approx(1e6)


def test_what_an_opportunity_leaves_over_serves_those_that_wait(rates):
    up = rates(10, 30, 100)
    assert [up.send(0, n, 722, 0)[0] // MS for n in range(3)] == [10, 10, 30]
    assert up.send(0, 3, 722, 40 * MS)[0] // MS == 100, "what nobody waited for at 30 ms is lost"
    assert up.send(0, 4, 3000 - 28, 150 * MS)[0] // MS == 210, "200 and 210"


def test_a_full_queue_drops(rates):
    up = rates(12, queue_packets=2)
    assert [len(up.send(0, n, 1000, 0)) for n in range(4)] == [1, 1, 0, 0]


def test_opportunities_at_one_instant_are_used_once_each():
    line = Opportunities([5, 5, 10])
    assert [line.leave_ns(1500, 5) for _ in range(4)] == [5, 5, 10, 15]


@pytest.mark.parametrize("text", ["5\n3\n", "1.5\n", "0\n", "", "a\n"])
def test_a_file_that_is_no_capacity_trace_is_refused(tmp_path, text):
    (tmp_path / "a.up").write_text(text)
    with pytest.raises(BadInputError, match=r"rate_trace .*a\.up"):
        read_opportunities(tmp_path / "a.up")


def test_the_period_of_handover_acts_at_random_alone():
    uplink = link.read_profile("handover").uplink
    assert (uplink.period_ns, LinkSchedule(uplink).period_ns) == (30_000 * MS, None)
