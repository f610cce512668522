# SPDX-License-Identifier: Apache-2.0

"""How a robot executes chunks of actions that arrive late."""

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from cloudrc.base import plugins
from cloudrc.base.errors import BadInputError
from cloudrc.gym import Networked
from tests.gym.envs import Counter, both_ways
from tests.support.pages import blocks


def answer(observation, size):
    """Return the chunk to an observation: action i is its tick plus i / 1000."""
    return (observation[0] + np.arange(size) / 1000)[:, None].astype(np.float32)


def flown(executor, link, steps=12, **options):
    """Return the actions that the robot executes."""
    env = Networked(Counter(), link, chunk=4, executor=executor, **options)
    observation, _ = env.reset()
    for _ in range(steps):
        observation, *_ = env.step(answer(observation, 4))
    return [round(float(each[0]), 3) for each in env.unwrapped.executed]


def test_committed_actions_count_as_bytes_of_the_observation():
    link = {"uplink": {"rate_kbit": 1024}, "downlink": {}}  # 128 bytes take 1 ms
    executor = {"name": "rtc", "execute": 4}
    env = Networked(
        Counter(), link, chunk=8, executor=executor, start="answer", observation_bytes=100
    )
    env.reset()
    for _ in range(30):
        env.step(np.zeros((8, 1), np.float32))
    sent = env.summary()["uplink"]["delay_measured"]  # with 28 bytes of headers and 4 actions left
    assert sent == pytest.approx((128 + 4 * 4) / 128e3, abs=1e-8)


@pytest.mark.parametrize(
    ("aggregate", "share_of_new"),
    [("latest", 1.0), ("weighted", 0.7), ("average", 0.5), ("conservative", 0.3)],
)
def test_async_merges_what_two_answers_mean_for_one_action(aggregate, share_of_new):
    executor = {"name": "async", "share": 0.5, "aggregate": aggregate}
    found = flown(executor, both_ways(0, 20), steps=6, start="answer")
    # Two of four actions are left after tick 2: the answer to this observation acts in tick 4.
    assert found == [0, 0.001, 0.002, 0.003, 2.002, 2.003]
    found = flown(executor, both_ways(0, 10), steps=4, start="answer")
    assert found[3] == pytest.approx((1 - share_of_new) * 0.003 + share_of_new * 2.001, abs=6e-4)


def test_async_skips_nothing_after_it_had_no_action():
    executor = {"name": "async", "share": 0.0, "aggregate": "latest"}
    found = flown(executor, both_ways(0, 30), steps=12, start="answer")
    assert found == [0, 0.001, 0.002, 0.003, *[0.003] * 3, 4, 4.001, 4.002, 4.003, 4.003]


@pytest.mark.parametrize("name", ["async", "rtc", "broker"])
def test_executors_with_one_open_question_ask_again_after_a_loss(name):
    deaf = {"uplink": {"blackouts": [{"start_s": 0.0, "duration_s": 0.045}]}}
    executor = {"name": name, "patience": 0.05}
    found = flown(executor, deaf, steps=14, start="answer")
    assert max(found) > 4


def test_rtc_tells_what_is_left_and_the_largest_delay_of_late():
    executor = {"name": "rtc", "execute": 4, "memory": 2}
    way = {"downlink": {"delay_ms": 20, "changes": [{"at_s": 0.15, "delay_ms": 5}]}}
    env = Networked(Counter(), way, chunk=8, executor=executor, start="answer")
    observation, info = env.reset()
    told = {}
    for _ in range(30):
        about = info["cloudrc"]
        if about["asked"] and observation[0]:
            told[int(observation[0])] = [float(each[0]) for each in about["prefix"]], about["delay"]
        observation, *_, info = env.step(answer(observation, 8))
    assert told[4][0] == pytest.approx([0.004, 0.005, 0.006, 0.007], abs=1e-6)
    assert list(told) == [4, 8, 12, 16, 20, 24, 28]
    assert [each for _, each in told.values()] == [1, 2, 2, 2, 2, 1, 1]  # the first is expected


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
    env = Networked(Counter(), shaky, 3, chunk=5, executor=name)

    def fly():
        observation, _ = env.reset(seed=1)
        for _ in range(200):
            observation, *_ = env.step(np.full((5, 1), observation[0], np.float32))
        return [float(each[0]) for each in env.unwrapped.executed]

    assert fly() == fly()


def test_an_executor_corrects_actions_with_the_newest_observation(tmp_path):
    """The chunks stand still; the example of the page damps what it sees on board."""
    (tmp_path / "corrected.py").write_text(
        next(each for each in blocks("plugins-executor", "python") if "Corrected" in each)
    )
    executed, speeds = [], []
    for link in ("ideal", "lte"):
        pendulum = gymnasium.wrappers.TransformAction(
            gymnasium.make("Pendulum-v1"),
            lambda action: executed.append(float(action[0])) or action,
            None,
        )
        name = str(tmp_path / "corrected.py")
        env = Networked(pendulum, link, 1, chunk=30, executor=name, start="answer")
        env.reset(seed=1)
        for _ in range(20):
            speeds.append(pendulum.unwrapped.state[1])
            env.step(np.zeros((30, 1), np.float32))
    both = [(-0.5 * speed, action) for speed, action in zip(speeds, executed, strict=True)]
    assert [action for _, action in (both[0], both[20])] == [0.0, 0.0]
    expected, found = zip(*(both[1:20] + both[21:]), strict=True)
    assert found == pytest.approx(expected, abs=1e-6)
