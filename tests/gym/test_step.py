"""The time of a step of an environment: who tells it, and what is refused."""

import gymnasium
import pytest
from gymnasium.vector import SyncVectorEnv
from gymnasium.wrappers import MaxAndSkipObservation, TransformAction

from cloudrc.errors import BadInputError
from cloudrc.gym import Networked, NetworkedVector
from cloudrc.gym.step import find_step
from tests.gym.envs import Counter


def telling(fps=None, **told):
    """Return an environment that tells the given times and rates."""
    attributes = {"dt": None, "metadata": {"render_modes": [], "render_fps": fps}, **told}
    return type("Told", (Counter,), attributes)()


@pytest.mark.parametrize(
    ("told", "seconds", "name"),
    [
        ({"step_dt": 0.02, "dt": 0.02, "fps": 25}, 0.02, "step_dt"),
        ({"control_hz": 10, "fps": 10}, 0.1, "control_hz"),
        ({"config": {"policy_frequency": 1, "simulation_frequency": 15}, "fps": 15}, 1.0, "policy"),
        ({"config": {"dt": 5.0, "tau": 0.005}, "fps": 20}, 0.05, "render_fps"),
        ({"control_hz": 50, "dt": 0.02, "fps": 10}, 0.02, "control_hz"),
        ({"dt": 0.05, "fps": 30}, 0.05, "dt"),
        ({"tau": 0.02, "fps": 50}, 0.02, "tau"),
        ({"fps": 4}, 0.25, "render_fps of Told, a film's rate"),
    ],
)
def test_what_tells_control_is_preferred_to_a_step_and_this_to_a_film(told, seconds, name):
    step = find_step(telling(**told), None)
    assert step.seconds == pytest.approx(seconds)
    assert step.source.startswith(name)
    assert Networked(telling(**told)).dt == step.seconds


@pytest.mark.parametrize(
    ("told", "words"),
    [
        ({"dt": 0.01, "control_hz": 10}, "control_hz says 0.1 s, dt says 0.01 s.*may be 0.1$"),
        ({"dt": 0.01, "fps": 10}, "dt says 0.01 s, render_fps says 0.1 s.*may be 0.1"),
        ({"dt": 0.003, "fps": 33}, "may be 0.0303"),  # a rounded 33.3
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


class Repeat(gymnasium.Wrapper):
    """Takes an action as often as it is told, in a way of its own."""

    def __init__(self, env, count):
        super().__init__(env)
        self.count = count

    def step(self, action):
        total, done, left = 0.0, False, self.count
        while left and not done:
            observation, reward, ended, late, info = self.env.step(action)
            total, done, left = total + reward, ended or late, left - 1
        return observation, total, ended, late, info


class Listing(gymnasium.Wrapper):
    """Repeats in a comprehension, and says something else."""

    skip_noops = True

    def __init__(self, env):
        super().__init__(env)
        self.skip_noops = True

    def step(self, action):
        return [self.env.step(action) for _ in range(4)][-1]


class Once(Repeat):
    """Repeats once, and says so."""

    def __init__(self, env):
        super().__init__(env, 1)
        self._frame_skip = 1


@pytest.mark.parametrize(
    "repeat",
    [
        lambda env: MaxAndSkipObservation(env, 4),
        lambda env: Repeat(env, 3),
        Listing,
    ],
)
def test_a_wrapper_that_makes_several_steps_of_one_is_refused_and_dt_decides(repeat):
    def make():
        return repeat(gymnasium.make("Pendulum-v1"))

    with pytest.raises(BadInputError, match="is several steps of PendulumEnv; give dt="):
        Networked(make())
    with pytest.raises(BadInputError, match="is several steps of PendulumEnv; give dt="):
        NetworkedVector(SyncVectorEnv([make]))
    assert Networked(make(), dt=0.2).dt == 0.2


def test_a_wrapper_that_makes_one_step_of_one_is_no_matter():
    env = gymnasium.make("Pendulum-v1")
    for made in (Once(env), TransformAction(env, lambda action: action, None)):
        assert Networked(made).dt == 0.05
    assert Networked(Networked(env)).dt == 0.05


@pytest.mark.parametrize(
    "name",
    ["Acrobot-v1", "Pendulum-v1", "CartPole-v1", "MountainCar-v0", "Humanoid-v5", "Hopper-v5"],
)
def test_environments_of_gymnasium_keep_their_step(name):
    expected = {"Acro": 0.2, "Pend": 0.05, "Cart": 0.02, "Moun": 1 / 30, "Huma": 0.015}
    env = gymnasium.make(name)
    assert Networked(env).dt == pytest.approx(expected.get(name[:4], 0.008))


@pytest.mark.parametrize(("compute", "doubtful"), [(20, True), ((20.0, 1.0), True), (2.0, False)])
def test_a_time_for_an_answer_of_very_many_steps_is_a_warning(compute, doubtful, recwarn):
    Networked(gymnasium.make("CartPole-v1"), compute=compute)
    NetworkedVector(gymnasium.make_vec("CartPole-v1", 2, "sync"), compute=compute)
    says = "compute: an answer takes 20 s, as long as 1,000 steps of the environment; the unit is s"
    assert [str(each.message) for each in recwarn] == [says] * 2 * doubtful
