# SPDX-License-Identifier: Apache-2.0

"""Episodes over a schedule: where each begins, what was asked, and links that vary."""

from math import isnan

import numpy as np
import pytest
from gymnasium.vector import SyncVectorEnv

from cloudrc.base.errors import BadInputError
from cloudrc.gym import Networked, NetworkedVector
from cloudrc.gym.asked import Met, PartsAsked
from cloudrc.gym.lane import Wire
from cloudrc.link.library import read_profile
from tests.gym.envs import Counter, both_ways, told

SECOND = 1_000_000_000
LINE = {"blackouts": [{"start_s": 1, "duration_s": 0.5}], "repeat_s": 4, "delay_ms": 20}
LINKS = ["lte", both_ways(10, 10), "wifi"]


def episode(link, seed, **options):
    env = Networked(Counter(limit=50), link, 1, **options)
    env.reset(seed=seed)
    answer = np.zeros(env.action_space.shape, np.float32)
    return [env.step(answer) for _ in range(50)][-1][4]["cloudrc"]["episode"]


@pytest.fixture
def drive(tmp_path):
    """The path of a trace of a minute, with a delay of its own in each second."""
    rows = "".join(f"{n},{20 + n}\n" for n in range(60))
    (tmp_path / "drive.csv").write_text(f"time_s,delay_ms\n{rows}")
    return str(tmp_path / "drive.csv")


def test_seeds_over_one_trace_meet_other_parts_and_executors_of_a_seed_the_same(drive):
    link = {"uplink": {"trace": drive}, "downlink": {"trace": drive}}

    def of(seed, executor="newest"):
        found = episode(link, seed, executor=executor, chunk=20)
        return found["link_start"], found["uplink"]["delay_measured"]

    starts, delays = zip(*map(of, (1, 2, 3)), strict=True)
    assert len({*starts}) == len({*delays}) == 3
    assert of(2, "ensemble") == of(2)
    assert all(0.0 < start < 60.0 for start in starts)


@pytest.mark.parametrize(
    ("link", "start"),
    [
        ({"uplink": {k: v for k, v in LINE.items() if k != "repeat_s"}}, 0.0),
        ({"uplink": LINE, "start_s": 0}, 0.0),
        ({"uplink": LINE, "start_s": 1.25}, 1.25),
        ("lte", 0.0),
    ],
)
def test_who_says_when_means_it(link, start):
    assert episode(link, 3)["link_start"] == start


def test_robots_of_a_vector_begin_at_places_of_their_own():
    env = NetworkedVector(SyncVectorEnv([lambda: Counter(limit=3)] * 4), {"uplink": LINE}, 1)
    env.reset(seed=0)
    for _ in range(3):
        info = env.step(np.zeros((4, 1), np.float32))[-1]
    assert len({*info["cloudrc"]["episode"]["link_start"].tolist()}) == 4


def wire(uplink):
    return Wire(read_profile({"uplink": uplink}), True, 100, "datagrams", 1200)


def test_what_is_asked_is_that_of_the_part_that_is_met():
    asked = PartsAsked(wire({**LINE, "loop": True}), 0.01)
    for begin, length, lost in ((0, 1, 0.0), (0.5, 1, 0.5), (1, 0.5, 1.0), (3, 10, 1.0 / 10)):
        delay, loss = asked.of(Met(round(begin * SECOND), round(length * SECOND)))
        assert loss == pytest.approx(lost)
        assert isnan(delay) if lost == 1.0 else delay == pytest.approx(0.02)


@pytest.mark.parametrize(
    ("values", "delay", "loss"),
    [
        ({"jitter_ms": 20, "delay_ms": 10}, 0.01125, 0.0),  # uniform, cut off at 0
        ({"jitter_ms": 20, "delay_ms": 30, "duplicate": 1.0}, 0.03 - 0.02 / 3, 0.0),
        ({"delay_ms": 10, "reorder": 0.5, "corrupt": 0.1}, 0.005, 0.1),
        ({"delay_ms": 10, "loss": {"bad_start": 0.1, "bad_end": 0.3, "delay_bad_ms": 40,
                                   "loss_bad": 0.5}}, 0.01 + 0.04 / 7, 0.125),
        ({"delay_ms": 10, "rate_kbit": 102.4}, 0.01 + 0.01, 0.0),
    ],
)  # fmt: skip
def test_the_pieces_of_a_schedule_ask_for_what_is_true_by_hand(values, delay, loss):
    change = {"at_s": 1000, "delay_ms": 999}
    found = PartsAsked(wire({**values, "changes": [change]}), 0.02).of(Met(0, 100 * SECOND))
    assert found == pytest.approx((delay, loss), rel=2e-3)


@pytest.mark.parametrize(
    ("delivery", "delay", "loss"),
    [
        ("datagrams", 0.02, 1 - 0.99**10),
        ("stream", 0.02 + 0.99 * (1 - 0.99**9) * 0.04 + 0.01 * 0.24, 0.0),
    ],
)
def test_messages_of_ten_packets_ask_for_what_their_part_of_the_line_does(delivery, delay, loss):
    """A repair takes a round trip; that of the last packet, with none behind it, 200 ms more."""
    there = {"delay_ms": 20, "loss": 0.01, "changes": [{"at_s": 400, "loss": 0}]}
    link = read_profile({"uplink": there, "downlink": {"delay_ms": 20}})
    asked = PartsAsked(Wire(link, True, 12_000, delivery, 1200), 0.5)
    found = asked.of(Met(0, 400 * SECOND))
    assert found[0] == pytest.approx(delay, abs=1.5e-3)
    assert found[1] == pytest.approx(loss, abs=0.02)
    assert asked.of(Met(401 * SECOND, SECOND)) == pytest.approx((0.02, 0.0))


def test_one_of_several_links_is_drawn_for_each_episode_and_named():
    env = Networked(Counter(limit=2), LINKS, 1)

    def names(env, seeds):
        return [told(env, 2, seed)[-1]["episode"]["link"] for seed in seeds]

    found = names(env, range(60))
    assert {*found} == {"lte", "link 2 of 3", "wifi"}
    assert found == names(Networked(Counter(limit=2), LINKS, 1, chunk=None), range(60))
    assert found != names(Networked(Counter(limit=2), LINKS, 1, stream="b"), range(60))
    assert min(found.count(name) for name in found) >= 8, "each as often"


def test_a_function_gives_the_link_of_each_reset_once():
    seeds = []

    def link(seed):
        seeds.append(seed)
        return both_ways(10 * seed, 10) if seed < 9 else "lte"

    env = Networked(Counter(limit=20), link, 1)
    found = [told(env, 20, seed)[-1]["episode"] for seed in (3, 4, 9)]
    assert seeds == [3, 4, 9]
    assert [round(each["uplink"]["delay_measured"], 3) for each in found[:2]] == [0.03, 0.04]
    assert found[2]["link"] == "lte"
    env.reset()
    assert seeds[3:] != [None]


def test_a_link_that_is_none_is_refused_where_it_is_given():
    with pytest.raises(BadInputError, match="the list is empty"):
        Networked(Counter(), [])
    with pytest.raises(BadInputError, match="no profile named 'ltee'"):
        Networked(Counter(), ["lte", "ltee"])
    env = Networked(Counter(), lambda seed: 5)
    with pytest.raises(BadInputError, match="a link is the name or path of a profile"):
        env.reset(seed=1)
