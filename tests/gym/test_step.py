# SPDX-License-Identifier: Apache-2.0

"""The time of a step of an environment: who tells it, and what is refused."""

import gymnasium
import pytest
from gymnasium.vector import SyncVectorEnv

from cloudrc.base.errors import BadInputError
from cloudrc.gym import Networked, NetworkedVector
from cloudrc.gym.step import find_step
from tests.gym.envs import Counter


def telling(fps=None, **told):
    """Return an environment that tells the given times and rates."""
    attributes = {"dt": None, "metadata": {"render_fps": fps}, **told}
    return type("Told", (Counter,), attributes)()


@pytest.mark.parametrize(
    ("told", "seconds", "name"),
    [
        ({"step_dt": 0.02, "dt": 0.02, "fps": 25}, 0.02, "step_dt"),
        ({"dt": 0.01, "control_hz": 10}, 0.1, "control_hz"),
        ({"config": {"policy_frequency": 1, "simulation_frequency": 15}, "fps": 15}, 1.0, "policy"),
        ({"dt": 0.05, "fps": 30}, 0.05, "dt"),
    ],
)
def test_what_tells_control_is_preferred_to_a_step_and_this_to_a_film(told, seconds, name):
    step = find_step(telling(**told), None)
    assert step.seconds == pytest.approx(seconds)
    assert step.source.startswith(name)
    assert Networked(telling(**told)).step_time == step


def test_a_film_s_rate_is_told_where_the_environment_is_wrapped():
    with pytest.warns(UserWarning, match=r"0.25 s \(render_fps of Told, a film's rate\).*give dt="):
        env = Networked(telling(fps=4))
    assert env.dt == 0.25
    assert Networked(telling(fps=4), dt=0.1).step_time == (0.1, "given")


class Four(gymnasium.Wrapper):
    """Steps four times, which no name of it tells."""

    def step(self, action):
        for _ in range(4):
            found = self.env.step(action)
        return found


class Once(gymnasium.Wrapper):
    """Steps once, and has a loop."""

    def step(self, action):
        found = self.env.step(sum(each for each in [action]))
        for _ in range(4):
            found[4]["more"] = True
        return found


def test_a_wrapper_that_steps_several_times_is_named_and_dt_decides():
    with pytest.raises(BadInputError, match="a step of Four is several steps of Counter; give dt="):
        Networked(Once(Four(Counter())))
    assert Networked(Four(Counter()), dt=0.04).dt == 0.04
    assert Networked(Once(Counter())).dt == 0.01


@pytest.mark.parametrize(
    ("told", "words"),
    [
        ({"dt": 0.01, "fps": 10}, "dt says 0.01 s, render_fps says 0.1 s"),
        ({"dt": 0.003, "fps": 33}, "render_fps says 0.0303 s"),  # a rounded 33.3
        ({}, "has no time step"),
    ],
)
def test_a_time_that_may_be_a_part_of_a_step_is_refused_and_dt_decides(told, words):
    for wrap, env in (
        (Networked, telling(**told)),
        (NetworkedVector, SyncVectorEnv([lambda: telling(**told)])),
    ):
        with pytest.raises(BadInputError, match=f"{words}") as caught:
            wrap(env)
        assert "give dt=, the time of a step in seconds" in str(caught.value)
    assert Networked(telling(**told), dt=0.05).dt == 0.05


@pytest.mark.filterwarnings("ignore:a step takes")  # of MountainCar
@pytest.mark.parametrize(
    "name",
    ["Acrobot-v1", "CartPole-v1", "MountainCar-v0", "Humanoid-v5"],
)
def test_environments_of_gymnasium_keep_their_step(name):
    expected = {"Acro": 0.2, "Cart": 0.02, "Moun": 1 / 30, "Huma": 0.015}
    assert Networked(gymnasium.make(name)).dt == pytest.approx(expected[name[:4]])
