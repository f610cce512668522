# SPDX-License-Identifier: Apache-2.0

"""The link as a library: imports, bits of the flights, streams, tables, profiles, bad input."""

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import cloudrc.link
from cloudrc.base.errors import BadInputError
from cloudrc.config import shipped
from cloudrc.link import DirectionProfile, GilbertElliott, OneWay, Trace
from cloudrc.link.library import KIND
from cloudrc.link.model import LinkDirection
from cloudrc.wire.tunnel.codec import Kind
from tests.link.profiles import blackout, change, profile_of
from tests.link.test_model import profiles
from tests.support.pages import run_page
from tests.support.programs import loaded

MS = 1_000_000
LIVELY = profile_of(0.07, 0.04, loss=0.1)


def sent(way, count, first, period_ns=10 * MS, episode=0):
    """Return the delays [s] of packets that are sent one by one; NaN if lost."""
    delays = np.full(count, np.nan)
    for n in range(count):
        now_ns = (first + n) * period_ns
        if arrivals := way.send(episode, first + n, 100, now_ns):
            delays[n] = (min(arrivals) - now_ns) * 1e-9
    return delays


def test_opening_a_link_loads_little_and_nothing_of_the_testbed():
    found = loaded("import cloudrc.link as link; link.open('lte', 1)")
    assert not {"pydantic", "cloudrc.config"} & found
    assert len([name for name in found if name.startswith("cloudrc")]) <= 17


def test_a_link_without_a_name_has_the_random_numbers_of_the_testbed():
    way, model = OneWay(LIVELY, 3, uplink=True), LinkDirection(LIVELY, 3, uplink=True)
    for n in range(300):
        assert way.send(2, n, 100, n * MS) == model.send(2, KIND, n, 100, n * MS)
    assert max(Kind) < KIND


@pytest.mark.parametrize("name", shipped.names("profile"))
def test_every_shipped_profile_opens_and_its_table_is_what_send_tells(name):
    for way in cloudrc.link.open(name, 5, stream="a"):
        found = way.table(600, 0.01, episode=2, first=100)
        assert np.array_equal(found, sent(way, 600, 100, episode=2), equal_nan=True)


@settings(max_examples=60, deadline=None)
@given(
    profile=profiles,
    corrupt=st.sampled_from([0.0, 0.2]),
    first=st.sampled_from([0, 1, 255, 256, 70_000]),
    stream=st.sampled_from(["", "robot-2"]),
    episode=st.sampled_from([0, 2]),
)
def test_a_table_is_what_send_tells_for_every_profile(profile, corrupt, first, stream, episode):
    profile = replace(profile, corrupt=corrupt)
    way = OneWay(profile, 7, uplink=False, stream=stream)
    found = way.table(300, 0.01, episode=episode, first=first)
    assert np.array_equal(found, sent(way, 300, first, episode=episode), equal_nan=True)


def test_a_long_table_of_independent_delays_has_no_seams():
    way = OneWay(LIVELY, 1, uplink=True)
    found = way.table(40_000, 0.001, first=300)
    assert np.array_equal(found, sent(way, 40_000, 300, MS), equal_nan=True)
    assert way.table(0, 0.01).shape == (0,)


def test_robots_with_one_seed_and_two_names_share_no_fate():
    ways = [OneWay(LIVELY, 1, uplink=True, stream=name) for name in ("", "a", "b")]
    first, second, third = (way.table(2000, 0.01) for way in ways)
    assert not np.intersect1d(first, second).size
    assert not np.intersect1d(second, third).size


def test_an_episode_begins_with_an_empty_bottleneck_and_at_the_start_of_the_schedule():
    slow = profile_of(0.01, rate=5e4, changes=(change(0.5, 0.1),))
    way = OneWay(slow, 1, uplink=True)
    first = [way.send(1, n, 1000, n * 100 * MS) for n in range(10)]
    assert first[0][0] < 200 * MS
    assert first[9][0] > 1700 * MS
    assert [way.send(2, n, 1000, n * 100 * MS) for n in range(10)] == first


def test_a_mapping_is_read_as_a_file_and_has_the_plain_classes(tmp_path):
    (tmp_path / "delays.csv").write_text("time_s,delay_ms\n0,20\n1,30\n")
    way = {
        "delay_ms": np.float64(40),
        "loss": {"bad_start": 0.1, "bad_end": 0.5},
        "changes": [{"at_s": 1, "loss": 0.5}],
        "blackouts": ({"start_s": 2, "duration_s": 1},),
    }
    trace = {"trace": str(tmp_path / "delays.csv")}
    profile = cloudrc.link.read_profile({"uplink": way, "downlink": trace})
    assert profile.uplink == DirectionProfile(
        delay_ms=40.0,
        loss=GilbertElliott(0.1, 0.5),
        changes=(change(1.0, loss=0.5),),
        blackouts=(blackout(2.0, 1.0),),
    )
    assert profile.downlink.rows == Trace((0.0, 1.0), (0.02, 0.03))
    (tmp_path / "mine.yaml").write_text("uplink: {trace: delays.csv}\n")
    (up, _), (same, _) = (cloudrc.link.open(p, 1) for p in (tmp_path / "mine.yaml", profile))
    assert up.table(3, 1.0) == pytest.approx([0.02, 0.03, 0.03])
    assert same.profile is profile.uplink


@pytest.mark.parametrize(
    ("profile", "words"),
    [
        ("let", "no profile named 'let'.*did you mean lte"),
        ({"uplink": {"delay": 40}}, "uplink.delay: no key named 'delay'; .*did you mean delay_ms"),
    ],
)
def test_a_profile_that_cannot_be_used_is_refused_in_one_line(profile, words):
    with pytest.raises(BadInputError, match=words) as caught:
        cloudrc.link.open(profile, 1)
    assert "\n" not in str(caught.value)


def test_the_examples_of_the_page_run(tmp_path, capsys):
    code = run_page("library", tmp_path)
    told = re.search(r"print\(arrivals\)  # (\(.*?\)):", code)[1]
    assert capsys.readouterr().out.startswith(told)
