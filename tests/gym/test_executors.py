"""How a robot executes chunks of actions that arrive late."""

import numpy as np
import pytest
from gymnasium import spaces

from cloudrc import plugins
from cloudrc.errors import BadInputError
from cloudrc.gym import Networked
from tests.gym.envs import Counter, both_ways


def flown(executor, link, chunk=4, steps=12, **options):
    """Return the actions that the robot executes, in thousands: the tick of the observation.

    Action i of the chunk to the observation of tick n is n + i / 1000.
    """
    env = Networked(Counter(), link, chunk=chunk, executor=executor, **options)
    observation, _ = env.reset()
    for _ in range(steps):
        answer = (observation[0] + np.arange(chunk) / 1000)[:, None].astype(np.float32)
        observation, *_ = env.step(answer)
    return [round(float(each[0]), 3) for each in env.unwrapped.executed]


def test_without_delay_all_but_the_broker_execute_the_first_action():
    for name in ("newest", "time_indexed", "time-indexed", "prefix"):
        assert flown(name, "ideal", steps=4) == [0, 1, 2, 3]
    assert flown("broker", "ideal", steps=9) == [
        *(0, 0.001, 0.002, 0.003, 4, 4.001, 4.002, 4.003, 8)
    ]


def test_newest_plays_an_answer_from_its_beginning():
    late = both_ways(10, 20)
    assert flown("newest", late, steps=7) == [0, 0, 0, 0.001, 1, 2, 3]
    # One answer in 40 ms: in between, the chunk goes on.
    assert flown("newest", "ideal", compute=0.02, steps=7) == [0, 0, 0, 0.001, 2, 2.001, 4]


def test_time_indexed_executes_the_action_of_its_tick():
    late = both_ways(10, 20)
    assert flown("time_indexed", late, steps=7) == [0, 0, 0.002, 0.003, 1.003, 2.003, 3.003]
    assert flown("time_indexed", late, steps=5, start="answer") == [0, 0.001, 0.002, 0.003, 1.003]


def test_a_chunk_that_is_shorter_than_the_delay_leaves_the_robot_without_actions():
    env = Networked(Counter(), both_ways(50, 50), chunk=4, executor="time_indexed")
    env.reset()
    for _ in range(20):
        info = env.step(np.ones((4, 1), np.float32))[4]
    assert info["cloudrc"]["held"]
    assert {float(each[0]) for each in env.unwrapped.executed} == {0.0}


def test_the_broker_asks_when_its_chunk_is_used_up_and_again_after_a_loss():
    late = both_ways(10, 20)
    found = flown("broker", late, steps=14)
    assert found == [0, 0, 0, 0.001, 0.002, 0.003, *[0.003] * 3, 6, 6.001, 6.002, 6.003, 6.003]
    deaf = {"uplink": {"blackouts": [{"start_s": 0.03, "duration_s": 0.05}]}}
    found = flown("broker", deaf, steps=120)
    assert found[4:104] == [0.003] * 100  # the question at 40 ms is lost; it is asked again at 1 s
    assert found[104] == 104


def test_the_ensemble_averages_what_all_answers_meant_for_the_tick():
    found = flown("ensemble", both_ways(10, 10), chunk=4, steps=6)
    assert found[:3] == [0, 0.001, 0.002]  # from one observation
    older, newer, weight = 1.003, 2.002, np.exp(-0.01)
    assert found[4] == pytest.approx((older + weight * newer) / (1 + weight), abs=1e-3)
    assert flown("ensemble", both_ways(10, 10), chunk=3, steps=5)[4] == newer  # the older has ended


def test_the_age_of_a_mean_is_the_weighted_mean_of_the_ages():
    env = Networked(Counter(), chunk=16, executor="ensemble")
    env.reset()
    for _ in range(40):
        told = env.step(np.zeros((16, 1), np.float32))[4]["cloudrc"]
    ages = np.arange(15, -1, -1)  # the oldest answer first
    assert told["action_age"] == pytest.approx(
        0.01 * np.average(ages, weights=np.exp(-0.01 * np.arange(16)))
    )


def test_the_policy_learns_the_actions_before_its_answer():
    env = Networked(Counter(), both_ways(15, 20), chunk=8, executor="prefix", start="answer")
    observation, info = env.reset()
    assert "prefix" not in info["cloudrc"]
    sent, answer = {}, None
    for tick in range(30):
        if not info["cloudrc"]["asked"]:
            observation, *_, info = env.step(answer)
            continue
        basis = int(observation[0])
        answer = np.arange(8, dtype=np.float32)[:, None] + 100 * tick
        prefix = info["cloudrc"].get("prefix", [])
        assert len(prefix) == (4 if tick else 0)  # 35 ms are 4 ticks
        assert [float(each[0]) for each in prefix] == [sent[basis + n] for n in range(len(prefix))]
        for place, action in enumerate(prefix):
            answer[place] = action
        sent.update({basis + n: float(each[0]) for n, each in enumerate(answer)})
        observation, *_, info = env.step(answer)
    executed = [float(each[0]) for each in env.unwrapped.executed]
    # What is told in the prefix is executed: each action from tick 4 on is the 5th of a chunk.
    assert all(each % 100 == 4 for each in executed[8:])


PLUGIN = '''
"""Executor: the last action of the newest answer."""
from cloudrc.gym.executors import Executor

class Last(Executor):
    needs_chunk = False
    def begin(self, ticks_late, period_ns):
        self.newest = None
    def receive(self, chunk, tick):
        self.newest, self.basis = chunk.actions[-1], chunk.basis
    def action(self, tick):
        return self.newest

def build() -> Last:
    return Last()
'''


def test_an_executor_of_ones_own_is_found_by_its_path(tmp_path):
    (tmp_path / "last.py").write_text(PLUGIN)
    assert flown(tmp_path / "last.py", "ideal", steps=3) == [0.003, 1.003, 2.003]
    (tmp_path / "other.py").write_text("class Other:\n    action = print\nbuild = Other\n")
    with pytest.raises(BadInputError, match=r"returned Other; return an Executor of"):
        flown(tmp_path / "other.py", "ideal")
    (tmp_path / "empty.py").write_text("")
    with pytest.raises(BadInputError, match=r"has no function build\(\)"):
        flown(tmp_path / "empty.py", "ideal")


@pytest.mark.parametrize(
    ("body", "error", "words"),
    [
        ("return numpy.array([numpy.nan])", BadInputError, "the action: it is"),
        ("self.basis = tick + 1; return [0]", ValueError, "its basis is 1, not"),
        ("1 / 0", ZeroDivisionError, "division"),
    ],
)
def test_what_an_executor_of_ones_own_does_wrong_is_told(tmp_path, body, error, words):
    text = PLUGIN.replace("return self.newest", f"import numpy; {body}")
    (tmp_path / "own.py").write_text(text)
    with pytest.raises(error, match=words):
        flown(tmp_path / "own.py", "ideal", steps=3)


@pytest.mark.parametrize("name", plugins.names("executors"))
def test_every_executor_takes_actions_of_several_values(name):
    space = spaces.Box(-1.0, 1.0, (2, 3))
    env = Networked(Counter(space), both_ways(20, 20), chunk=8, executor=name, start="answer")
    env.reset()
    for _ in range(10):
        env.step(np.full((8, 2, 3), 0.5, np.float32))
    assert all((action == 0.5).all() for action in env.unwrapped.executed)


@pytest.mark.parametrize("name", plugins.names("executors"))
def test_every_executor_says_what_it_is_and_forgets_the_last_episode(name):
    assert plugins.describe("executors", name).startswith("Executor: ")
    shaky = both_ways(20, 20, jitter_ms=15, loss=0.2)
    env = Networked(Counter(), shaky, 3, chunk=4, executor=name)

    def fly():
        observation, _ = env.reset(seed=1)
        for _ in range(200):
            observation, *_ = env.step(np.full((4, 1), observation[0], np.float32))
        return [float(each[0]) for each in env.unwrapped.executed]

    assert fly() == fly()
