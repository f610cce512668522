# SPDX-License-Identifier: Apache-2.0

"""Several loops share a channel: who is chosen, what arrives when, and closed forms of both."""

from functools import cache

import gymnasium
import numpy as np
import pytest

from cloudrc.base.errors import BadInputError
from cloudrc.gym import Channel, Networked, NetworkedVector, Waiting
from cloudrc.gym.schedules import change_of, find_schedule
from examples import channel as page
from tests.conftest import nightly_rows
from tests.gym.envs import Counter, Mixed

ROWS = [row._replace(measure=cache(row.measure)) for row in page.rows()]
EXACT = [row for row in ROWS if row.exact == row.exact]
TWO = "sum of x², 2 dead-beat loops"
DAILY = [(row, 0.1 if TWO in row.name else 0.2) for row in EXACT if "N = 20" not in row.name]
"""Rows and scales; ages of 20 robots are measured as those of 5 are."""


def counters(*steps, limit=10**9):
    """Make environments that observe the number of their step; of `steps` [s]."""
    made = [Counter(limit=limit) for _ in steps]
    for env, dt in zip(made, steps, strict=True):
        env.dt = dt
    return made


def seen(channel, seconds, seed=1):
    """Play with the answer 0; return time [ms] and number of each observation, by robot."""
    found = [[] for _ in channel.envs]
    ticks = [0] * len(found)
    for robot, observation, info in channel.play(seed, seconds):
        if info["cloudrc"]["asked"] and "episode" not in info["cloudrc"]:
            found[robot].append(
                (round(ticks[robot] * channel.dt[robot] * 1e3), int(observation[0]))
            )
            channel.answer(robot, [0.0])
        ticks[robot] += 1
    return found


@pytest.mark.parametrize(
    ("row", "scale"),
    DAILY + nightly_rows(*[(row, 1.0) for row in EXACT]),
    ids=lambda each: getattr(each, "name", None),
)
def test_a_closed_form_is_measured(row, scale):
    mean, error = row.at(scale, 8)
    assert error < 0.04 * row.exact
    assert abs(mean - row.exact) < 3.0 * error


def test_the_largest_error_depends_on_what_the_loops_do_with_an_observation():
    """It is worse than taking turns for dead-beat loops, and better for loops that hold; the error
    of a model is better for the former."""
    dead, hold = (
        {row.schedule: row.measure(steps, 8) for row in ROWS if name in row.name}
        for name, steps in ((TWO, 1_000), ("x², 2 loops that hold", 200))
    )

    def is_below(low, high):  # in pairs: both meet the same noise
        more = high - low
        return more.mean() > 3.0 * more.std(ddof=1) / np.sqrt(len(more))

    assert is_below(dead["round_robin"], dead["largest_error"])
    assert is_below(dead["error of a model"], dead["round_robin"])
    assert is_below(hold["largest_error"], hold["round_robin"])
    costs = dead["error of a model"]
    assert abs(costs.mean() - 6.37) < 3.0 * costs.std(ddof=1) / np.sqrt(len(costs)) + 0.02


def test_without_losses_the_largest_age_takes_turns():
    chosen = []
    for schedule in ("round_robin", "largest_age"):
        channel = Channel(counters(*[0.01] * 5), schedule=schedule)
        chosen.append(seen(channel, 0.3))
    assert chosen[0] == chosen[1]
    assert chosen[0][0][:3] == [(0, 0), (20, 1), (70, 6)]
    assert chosen[0][4][:3] == [(0, 0), (60, 5), (110, 10)]


def test_an_observation_arrives_at_the_end_of_its_slot_and_a_newer_one_takes_its_place():
    """Steps of 10 and 4 ms; a slot of 10 ms begins at 0, 10, 20 ms ..."""
    found = seen(Channel(counters(0.01, 0.004), slot_ms=10), 0.06)
    # At 10 ms the first robot leaves, at 20 ms the second one, with its observation of 20 ms.
    assert found[0] == [(0, 0), (20, 1), (40, 3)]
    assert found[1] == [(0, 0), (32, 5), (52, 10)]


def test_robots_that_act_at_the_same_time_act_in_the_order_of_their_numbers():
    """At 10 ms robot 1 has waited for an answer; robot 0 sends only then, and does not wait."""
    channel = Channel(counters(0.01, 0.02), schedule=None, answer_within=[0.0, 0.01])
    robots = [robot for robot, *_ in channel.play(1, 0.02)]
    assert robots == [0, 0, 1, 0, 1]  # at 0, 10, 10, 20 and 30 ms


def test_several_leave_in_a_slot_and_without_a_schedule_all_leave_at_once():
    both = seen(Channel(counters(0.01, 0.01), per_slot=2), 0.05)
    assert both == [[(0, 0), *[(10 * n, n - 1) for n in range(2, 5)]]] * 2
    alone = seen(Channel(counters(0.01, 0.01), schedule=None), 0.05)
    assert alone == [[(10 * n, n) for n in range(5)]] * 2


def test_without_a_channel_a_robot_is_that_of_networked():
    link = {"uplink": {"delay_ms": 7, "jitter_ms": 5, "loss": 0.2}, "downlink": {"loss": 0.2}}
    options = {"compute": 0.003, "observe_age": True, "deadline": 0.03}
    channel = Channel([gymnasium.make("Pendulum-v1")], link, schedule=None, seed=3, **options)

    def policy(given):
        return [-given["observation"][1] - float(given["age"][0])]

    (shared,) = channel.run(policy, 10.0, 5)
    env = Networked(gymnasium.make("Pendulum-v1"), link, 3, stream="robot0", **options)
    given, info = env.reset(seed=5)
    total, ended = 0.0, False
    while not ended:
        given, reward, _, ended, info = env.step(np.float32(policy(given)))
        total += reward
    alone = info["cloudrc"]["episode"]
    assert (shared.pop("return"), shared.pop("ended")) == (total, "truncated")
    assert repr(shared) == repr(alone)  # some numbers are NaN


@pytest.mark.parametrize("schedule", ["round_robin", "random", "largest_age", "largest_error"])
def test_losses_do_not_depend_on_the_schedule(schedule):
    """With an own slot in each step, the ticks that arrive are those that arrive alone."""
    link = {"uplink": {"loss": 0.4}}
    own, both = (
        seen(Channel(counters(0.01, 0.01), link, per_slot=2, schedule=each, seed=2), 1.0)
        for each in ("round_robin", schedule)
    )
    assert own == both
    chosen = seen(Channel(counters(0.01, 0.01), link, schedule=schedule, seed=2), 1.0)
    assert {n for _, n in chosen[0]} < {n for _, n in own[0]}


def test_a_file_chooses_from_what_waits(tmp_path, monkeypatch):
    path = tmp_path / "mine.py"
    path.write_text("def choose(waiting):\n    return len(waiting) - 1\n")
    assert [len(each) for each in seen(Channel(counters(0.01, 0.01), schedule=path), 0.1)] == [1, 9]
    found = []
    channel = Channel(
        counters(0.01, 0.01), schedule=lambda all: found.append(all[0]) or 0, hold="start"
    )
    for robot, _, info in channel.play(1, 0.04):
        channel.answer(robot, [7.0] if info["cloudrc"]["asked"] else [9.0])
    assert found[0][:4] == (0, pytest.approx(0.01), 1.0, 8)
    assert [float(each[0]) for each in found[0].actions] == [7.0]
    assert [float(found[1].observation[0]), float(found[1].seen[0])] == [2.0, 1.0]


@pytest.mark.parametrize(
    ("source", "said"),
    [
        ("def choose(waiting):\n    return 2\n", "the place it returned"),
        ("def choose(waiting):\n    return waiting[5]\n", "mine.py:2"),
        ("chose = 1\n", "no such function"),
    ],
)
def test_a_wrong_file_is_told_with_its_name(tmp_path, source, said):
    path = tmp_path / "mine.py"
    path.write_text(source)
    with pytest.raises(BadInputError, match=f"mine.py.*{said}"):
        seen(Channel(counters(0.01, 0.01), schedule=path), 0.1)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"schedule": "largest_eror"}, "largest_error"),
        ({"slot_ms": 0}, "slot_ms"),
        ({"per_slot": 0.5}, "per_slot"),
        ({"hold": ["start"]}, "1 in the list, and 2 environments"),
        ({"answers": "steps"}, "step"),
        ({"acknowledge": "all"}, "ideal"),
        ({"dt": [0.01, 0.02]}, "give slot_ms="),
    ],
)
def test_a_wrong_argument_is_told(arguments, said):
    with pytest.raises(BadInputError, match=f"Channel|{said}") as error:
        Channel(counters(0.01, 0.01), **arguments)
    assert said in str(error.value)


def test_each_robot_may_have_options_of_its_own():
    channel = Channel(
        counters(0.01, 0.02),
        ["ideal", {"uplink": {"delay_ms": 100}}],
        slot_ms=5,
        compute=[0.0, (0.01, 0.0)],
    )
    first, second = channel.run(lambda seen: [0.0], 2.0, 1)
    assert first["loop_age"] == pytest.approx(0.01)
    assert second["loop_age"] == pytest.approx(0.12)
    playing = channel.play(1)
    assert next(playing)[0] == 0
    with pytest.raises(BadInputError, match="robot 1"):
        channel.answer(1, [0.0])


def test_a_robot_whose_episode_ends_leaves_the_channel():
    envs = [*counters(0.01, limit=5), *counters(0.01)]
    channel = Channel(envs)
    first, second = channel.run(lambda seen: [0.0], 0.5, 1)
    assert (first["ended"], first["ticks"], second["ended"], second["ticks"]) == (
        "terminated",
        5,
        "limit",
        50,
    )
    assert second["uplink"]["sent"] > 43


def test_the_change_is_a_norm_over_all_numbers():
    env = Mixed()
    old, new = env.reset(seed=1)[0], env.reset(seed=2)[0]
    parts = (new["image"].astype(float) - old["image"]).ravel()
    number = int(new["state"][0]) - int(old["state"][0])
    vector = new["state"][1] - old["state"][1]
    exact = np.sqrt(parts @ parts + number**2 + vector @ vector)
    assert change_of(new, old) == pytest.approx(exact)


def test_draws_of_random_are_repeatable_and_even():
    waiting = [Waiting(n, 0.0, 0.0, 8, 0.0, 0.0, ()) for n in range(4)]
    schedule, every = find_schedule("random"), []
    for _ in range(2):
        schedule.begin(1, 5)
        every.append([schedule.choose(waiting) for _ in range(1000)])
    assert every[0] == every[1]
    assert np.bincount(every[0]) == pytest.approx([250] * 4, abs=60)


# The options `answers` and `acknowledge`.


def test_a_policy_that_answers_in_each_step_sends_a_packet_per_tick():
    link = {"uplink": {"loss": 0.5}}
    env = Networked(Counter(), link, 1, answers="step", acknowledge="ideal", hold="start")
    observation, info = env.reset(seed=1)
    ages = []
    for tick in range(50):
        assert info["cloudrc"]["asked"]
        observation, *_, info = env.step([float(tick)])
        about = info["cloudrc"]
        assert not about["held"]
        assert about["acknowledged"] == tuple(range(tick + 1))
        ages.append(round(about["action_age"] / 0.01))
        assert round(about["observation_age"] / 0.01) == tick + 1 - int(observation[0])
    assert [float(each[0]) for each in env.unwrapped.executed] == list(map(float, range(50)))
    assert max(ages) > 1
    assert env.summary()["downlink"]["sent"] == 50


def test_what_arrived_is_acknowledged_an_uplink_delay_later_and_only_the_newest():
    link = {"uplink": {"delay_ms": 30}, "downlink": {"delay_ms": 20, "loss": 0.3}}
    env = Networked(Counter(), link, 1, answers="step", acknowledge="ideal")
    env.reset(seed=1)
    for _ in range(200):
        *_, info = env.step([0.0])
    known = info["cloudrc"]["acknowledged"]
    assert len(known) == 100
    assert 190 <= known[-1] <= 195  # 20 ms down, 30 ms up, and those that are lost
    assert 0.5 < len(known) / (known[-1] - known[0]) < 0.9


def test_a_busy_policy_answers_when_it_is_free():
    env = Networked(Counter(), "ideal", 1, answers="step", compute=0.025)
    _, info = env.reset(seed=1)
    asked = [info["cloudrc"]["asked"]]
    for _ in range(9):
        asked.append(env.step([0.0])[-1]["cloudrc"]["asked"])
    assert asked == [True, False, False] * 3 + [True]


def test_a_vector_has_the_options_too():
    envs = gymnasium.make_vec("CartPole-v1", 2, "sync")
    envs = NetworkedVector(envs, "ideal", 1, answers="step", acknowledge="ideal")
    envs.reset(seed=1)
    for _ in range(3):
        *_, infos = envs.step(np.zeros(2, int))
    assert infos["cloudrc"]["acknowledged"].tolist() == [(0, 1, 2)] * 2
