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


def test_the_broker_asks_again_after_a_loss():
    deaf = {"uplink": {"blackouts": [{"start_s": 0.03, "duration_s": 0.05}]}}
    found = flown("broker", deaf, steps=120)
    assert found[4:104] == [0.003] * 100  # the question at 40 ms is lost; it is asked again at 1 s
    assert found[104] == 104


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
