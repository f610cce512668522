# SPDX-License-Identifier: Apache-2.0

"""Vector environments: each robot has a link of its own, in each way of automatic reset."""

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from cloudrc.gym import Networked, NetworkedVector
from tests.gym.envs import Counter, Mixed, both_ways

LINK = both_ways(40, 30, jitter_ms=30, loss=0.1)


def cartpoles():
    arguments = {"autoreset_mode": AutoresetMode.DISABLED}
    return gymnasium.make_vec("CartPole-v1", 3, "sync", vector_kwargs=arguments)


def test_an_ideal_link_changes_no_bit_and_a_mask_selects_who_begins_again():
    bare, env = cartpoles(), NetworkedVector(cartpoles(), "ideal")
    assert np.array_equal(bare.reset(seed=3)[0], env.reset(seed=3)[0])
    rng = np.random.default_rng(0)
    for _ in range(80):
        actions = rng.integers(0, 2, 3)
        expected, found = bare.step(actions), env.step(actions)
        assert all(np.array_equal(expected[n], found[n]) for n in range(4))
        mask = expected[2] | expected[3]
        if mask.any():
            options = ({"reset_mask": mask.copy()} for _ in range(2))
            first, second = (each.reset(options=next(options)) for each in (bare, env))
            assert np.array_equal(first[0], second[0])


def same(observations, n, found):
    """Return whether the observation of robot n among those of all is the one that was found."""
    if isinstance(found, dict) and isinstance(observations, dict):
        return all(np.array_equal(observations[key][n], found[key]) for key in found)
    return np.array_equal(observations[n], found)


@pytest.mark.filterwarnings("ignore:two robots")  # those of the vector, and alone
@pytest.mark.parametrize("memory", [{}, {"observe_step": True, "observe_actions": 2}])
@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP])
def test_a_robot_of_a_vector_flies_as_alone_with_its_stream(mode, memory):
    def count():
        return Counter(limit=25)

    env = NetworkedVector(SyncVectorEnv([count] * 2, autoreset_mode=mode), LINK, 5, **memory)
    alone = [Networked(count(), LINK, 5, stream=f"/{robot}", **memory) for robot in range(2)]
    env.reset(seed=8)
    for n, one in enumerate(alone):
        one.reset(seed=8 + n)
    ended = False
    for step in range(70):
        actions = np.full((2, 1), step, np.float32)
        observations, rewards, ends, _, infos = env.step(actions)
        for n, one in enumerate(alone):
            if ended and mode is AutoresetMode.NEXT_STEP:
                found, told = one.reset()
            else:
                found, reward, over, _, told = one.step(actions[n])
                assert (reward, over) == (rewards[n], ends[n])
                if over and mode is AutoresetMode.SAME_STEP:
                    final = infos["final_info"]["cloudrc"]["episode"]["ticks"]
                    assert final[n] == told["cloudrc"]["episode"]["ticks"] == 25
                    final = infos["final_obs"][n]
                    assert same(final, ..., found)
                    assert infos["final_info"]["count"][n] == told["count"]
                    found, told = one.reset()
            assert same(observations, n, found)
            assert infos["count"][n] == told["count"]
            assert infos["cloudrc"]["lost_uplink"][n] == told["cloudrc"]["lost_uplink"]
        ended = bool(ends[0])


def test_chunks_and_spaces_of_every_kind():
    env = NetworkedVector(SyncVectorEnv([Mixed] * 2), LINK, chunk=5, executor="time_indexed")
    bare = SyncVectorEnv([Mixed] * 2)
    observation, _ = env.reset(seed=1)
    assert env.observation_space == bare.observation_space
    assert env.observation_space.contains(observation)
    env.action_space.seed(0)
    for _ in range(20):
        observation, *_ = env.step(env.action_space.sample())
    assert env.observation_space.contains(observation)
